#!/usr/bin/env bash
# Makes a machine that vcan/guest/run.sh boots, if there is none yet, and prints its folder.
#
#   usage: vcan/guest/prepare.sh uml|qemu
#
# It downloads Debian's current kernel of that kind, a static busybox and, if missing, QEMU with apt, and unpacks
# them under ~/.cache/needle-bench/vcan (100 and 160 MB). It installs nothing.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cache=${XDG_CACHE_HOME:-$HOME/.cache}/needle-bench/vcan
kind=$1

die() {
    echo "vcan: $*" >&2
    exit 1
}

# The program that boots the kernel, and the modules to load; their dependencies are read from them and loaded
# first.
modules=(overlay vcan can_raw can_bcm)
case $kind in
uml) program=linux ;;
qemu) program=qemu-system-x86_64 modules+=(virtio_pci virtio_console 9pnet_virtio 9p kvaser_pci) ;;
*) die "VCAN_GUEST: no machine is called \"$kind\"; uml or qemu" ;;
esac

recipe=$(cat "$here"/{prepare.sh,init,vmlinux.py} | sha256sum | cut -c1-12)
machine=$cache/$recipe-$kind
mkdir -p "$cache"
exec 7>"$cache/lock"
flock 7
if "$machine/$program" --version >/dev/null 2>&1; then
    echo "$machine"
    exit
fi

by_hand="on a kernel of your own instead: sudo modprobe vcan && sudo ip link add dev vcan0 type vcan && sudo ip link set vcan0 up (vcan1 likewise)"
[ "$(uname -m)" = x86_64 ] || die "the machine is for x86_64, this is $(uname -m); $by_hand"
command -v apt-get >/dev/null || die "the machine is made from Debian packages and there is no apt-get here; $by_hand"
command -v python3 >/dev/null || die "no python3; sudo apt-get install python3"
echo "vcan: downloading a kernel with CAN, once, to $machine" >&2
if [ "$(id -u)" = 0 ]; then apt-get update -qq >&2; fi

work=$(mktemp -d "$cache/new.XXXXXX")
trap 'rm -rf "$work"' EXIT
cd "$work"
mkdir debs kernel busybox root machine

download() { # package...
    (cd debs && apt-get download -qq -o APT::Sandbox::User=root "$@") >&2 ||
        die "the download failed (above); sudo apt-get update, and try again; or $by_hand"
}

# Unpacks these files of the kernel's package.
unpack_kernel() { # package, pattern...
    dpkg-deb --fsys-tarfile debs/"$1"_*.deb | tar -x -C kernel --wildcards \
        '*/kernel/net/can/*' '*/kernel/drivers/net/can/*' '*/kernel/fs/overlayfs/*' "${@:2}"
    rm debs/"$1"_*.deb
}

make_uml() {
    kernel=user-mode-linux
    download "$kernel"
    unpack_kernel "$kernel" '*/linux.uml'
    mv kernel/usr/bin/linux.uml machine/linux
    machine/linux --version >/dev/null || die "the kernel does not start (above); VCAN_GUEST=qemu needs none that does"
}

make_qemu() {
    local missing=() deb
    # The metapackage names the current kernel; a fixed version would disappear within months.
    kernel=$(apt-cache depends linux-image-amd64 | sed -n 's/^ *Depends: \(linux-image-[0-9].*\)/\1/p' | head -n1)
    [ -n "$kernel" ] || die "apt knows no linux-image-amd64; sudo apt-get update, on Debian; $by_hand"
    if ! command -v qemu-system-x86_64 >/dev/null; then
        # The packages that its installation would add; this does not install them.
        mapfile -t missing < <(apt-get install --simulate --no-install-recommends qemu-system-x86 | sed -n 's/^Inst \([^ ]*\).*/\1/p')
    fi
    download "$kernel" "${missing[@]}"
    unpack_kernel "$kernel" '*/vmlinuz-*' '*/kernel/drivers/virtio/*' '*/kernel/drivers/char/virtio_console.ko*' \
        '*/kernel/net/9p/*' '*/kernel/fs/9p/*' '*/kernel/fs/netfs/*' '*/kernel/fs/fscache/*'
    if [ -n "${missing[*]:-}" ]; then
        for deb in debs/*.deb; do dpkg -x "$deb" machine/qemu; done
        cat >machine/qemu-system-x86_64 <<'EOF'
#!/bin/sh
# The QEMU unpacked beside this file, with its own libraries and firmware.
here=$(dirname "$0")/qemu
export LD_LIBRARY_PATH="$here/usr/lib/x86_64-linux-gnu:$here/lib/x86_64-linux-gnu"
exec "$here/usr/bin/qemu-system-x86_64" -L "$here/usr/share/qemu" -L "$here/usr/share/seabios" "$@"
EOF
    else
        printf '#!/bin/sh\nexec qemu-system-x86_64 "$@"\n' >machine/qemu-system-x86_64
    fi
    chmod +x machine/qemu-system-x86_64
    machine/qemu-system-x86_64 --version >&2 || die "QEMU does not start (above)"
    # The unpacked kernel boots 5 s sooner under emulation than the one that unpacks itself.
    python3 "$here/vmlinux.py" kernel/boot/vmlinuz-* machine/vmlinux ||
        cp kernel/boot/vmlinuz-* machine/vmlinux
}

download busybox-static
dpkg -x debs/busybox-static_*.deb busybox
rm debs/busybox-static_*.deb
"make_$kind"
find kernel -name '*.ko.xz' -exec xz -d {} +

# Modules are numbered in the order to load them.
mkdir -p root/{bin,modules,proc,sys,dev}
declare -A added
add_module() {
    local name=${1//-/_} file dependency
    if [ -n "${added[$name]:-}" ]; then return; fi
    added[$name]=yes
    file=$(find kernel \( -name "$name.ko" -o -name "${name//_/-}.ko" \) -print -quit)
    [ -n "$file" ] || die "$kernel has no module $name where it was; see the list of folders in $0"
    for dependency in $(tr '\0' '\n' <"$file" | sed -n 's/^depends=//p' | tr , ' '); do
        add_module "$dependency"
    done
    cp "$file" "root/modules/$(printf %02d ${#order[@]})-$name.ko"
    order+=("$name")
}
order=()
for module in "${modules[@]}"; do add_module "$module"; done
install -m 755 busybox/bin/busybox "$here/init" root/bin/
mv root/bin/init root/init
(cd root && find . | ../busybox/bin/busybox cpio -o -H newc 2>/dev/null) | gzip -1 >machine/initrd.gz

chmod 755 machine
rm -rf "$machine"
mv machine "$machine"
find "$cache" -mindepth 1 -maxdepth 1 -type d ! -name "$recipe-*" ! -path "$work" -exec rm -rf {} +
echo "vcan: $kernel ready" >&2
echo "$machine"
