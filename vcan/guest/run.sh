#!/usr/bin/env bash
# Runs a command in a QEMU machine with Debian's kernel and vcan0 and vcan1 up.
#
#   usage: vcan/guest/run.sh [--keep DIR]... COMMAND [ARGUMENT]...
#
# vcan/run.sh usually calls it. The machine shares this one's root copy-on-write over 9p: it has the
# same programs, working folder and environment, but files written there are lost, except in the
# --keep folders. stdout, stderr and the exit status are those of the command; stdin is empty. Two exit
# statuses are added:
#   124  the command took longer than VCAN_TIMEOUT_S (300)
#   125  the machine itself failed; the end of its console is shown
# The machine has an emulated CAN controller as well: can0, down, which NEEDLE_CAN names to tests that change
# its settings. VCAN_CPUS (1) and VCAN_MEMORY_MB (2048) set the size of the machine.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
limit_s=${VCAN_TIMEOUT_S:-300}

keep=()
while [ "${1:-}" = --keep ]; do
    keep+=("$(realpath -e "$2")")
    shift 2
done
[ $# -gt 0 ] || { echo "usage: $0 [--keep DIR]... COMMAND [ARGUMENT]..." >&2; exit 125; }

machine=$("$here/prepare.sh") || exit 125
shared=$(mktemp -d "${TMPDIR:-/tmp}/vcan.XXXXXX")
trap 'rm -rf "$shared"' EXIT

# The machine's init reads the command and the folders to mount writable.
{
    export -p
    echo 'export NEEDLE_VCAN=1 NEEDLE_CAN=can0 TMPDIR=/tmp'
    printf 'cd %q || exit 126\nexec' "$PWD"
    printf ' %q' "$@"
    echo
} >"$shared/command"
: >"$shared/keep"
share() { # tag, folder, further options
    qemu_args+=(-virtfs "local,mount_tag=$1,path=$2,security_model=none,multidevs=remap$3")
}
qemu_args=()
share root / ,readonly=on
share shared "$shared" ''
for i in "${!keep[@]}"; do
    share "keep$i" "${keep[i]}" ''
    echo "${keep[i]}" >>"$shared/keep"
done

# Opening /dev/kvm is not enough: without the processor's virtualisation it may exist and not run
# this machine.
accel=tcg cpu=max
if [ -w /dev/kvm ] && grep -qwE 'vmx|svm' /proc/cpuinfo; then accel=kvm cpu=host; fi

# norandmaps: every process has its code at the same addresses, so that the emulation translates it once. A jog,
# with its record, takes 4 s instead of 12.

# The output goes through pipes, because QEMU needs write-only descriptors and a terminal is not one.
exec 8> >(exec cat) && out=$!
exec 9> >(exec cat >&2) && err=$!
status=0
timeout --foreground --kill-after=5 "$limit_s" "$machine/qemu-system-x86_64" \
    -nodefaults -no-user-config -display none -no-reboot \
    -machine q35 -accel "$accel" -cpu "$cpu" \
    -smp "${VCAN_CPUS:-1}" -m "${VCAN_MEMORY_MB:-2048}" \
    -kernel "$machine/vmlinux" -initrd "$machine/initrd.gz" \
    -append "console=ttyS0 quiet panic=-1 mitigations=off nokaslr norandmaps apparmor=0 audit=0 random.trust_cpu=on no_timer_check" \
    -object can-bus,id=wire -device kvaser_pci,canbus=wire \
    -serial "file:$shared/console" -device virtio-serial-pci \
    -add-fd fd=8,set=1 -chardev file,id=out,path=/dev/fdset/1,append=on -device virtserialport,chardev=out,name=out \
    -add-fd fd=9,set=2 -chardev file,id=err,path=/dev/fdset/2,append=on -device virtserialport,chardev=err,name=err \
    "${qemu_args[@]}" </dev/null >"$shared/qemu" 2>&1 || status=$?
exec 8>&- 9>&-
wait "$out" "$err"

if [ -s "$shared/status" ]; then exit "$(cat "$shared/status")"; fi
if [ "$status" = 124 ]; then
    echo "vcan: no end after $limit_s s, so the machine was stopped; VCAN_TIMEOUT_S sets the limit" >&2
    exit 124
fi
echo "vcan: the machine ended without the command's exit status (QEMU's was $status). The end of its output:" >&2
tail -n 40 "$shared/qemu" "$shared/console" >&2 || true
echo "vcan: if its files are damaged, remove $machine and try again" >&2
exit 125
