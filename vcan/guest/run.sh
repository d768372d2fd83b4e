#!/usr/bin/env bash
# Runs a command in a virtual machine with Debian's kernel and vcan0 and vcan1 up.
#
#   usage: vcan/guest/run.sh [--keep DIR]... COMMAND [ARGUMENT]...
#
# vcan/run.sh usually calls it. The machine shares this one's root copy-on-write: it has the same
# programs, working folder and environment, but files written there are lost, except in the
# --keep folders. stdout, stderr and the exit status are those of the command; stdin is empty. Two exit
# statuses are added:
#   124  the command took longer than VCAN_TIMEOUT_S (300)
#   125  the machine itself failed; the end of its console is shown
# VCAN_GUEST chooses the machine:
#   uml   (the default) a kernel that runs as a program of this one, with one processor; what runs in it
#         computes at full speed
#   qemu  an emulated computer, several times slower, with an emulated CAN controller as well: can0, down,
#         which NEEDLE_CAN names to tests that change its settings. VCAN_CPUS (1) is its number of processors.
# VCAN_MEMORY_MB (2048) is the size of either. NEEDLE_GUEST=1 tells the command's tests where they run.
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
kind=${VCAN_GUEST:-uml}
limit_s=${VCAN_TIMEOUT_S:-300} memory_mb=${VCAN_MEMORY_MB:-2048}

keep=()
while [ "${1:-}" = --keep ]; do
    keep+=("$(realpath -e "$2")")
    shift 2
done
[ $# -gt 0 ] || { echo "usage: $0 [--keep DIR]... COMMAND [ARGUMENT]..." >&2; exit 125; }

machine=$("$here/prepare.sh" "$kind") || exit 125
shared=$(mktemp -d "${TMPDIR:-/tmp}/vcan.XXXXXX")
trap 'rm -rf "$shared"' EXIT

# The machine's init reads the command and the folders to mount writable.
{
    export -p
    echo 'export NEEDLE_VCAN=1 NEEDLE_GUEST=1 TMPDIR=/tmp'
    if [ "$kind" = qemu ]; then echo 'export NEEDLE_CAN=can0'; fi
    printf 'cd %q || exit 126\nexec' "$PWD"
    printf ' %q' "$@"
    echo
} >"$shared/command"
printf '%s\n' "${keep[@]}" >"$shared/keep"

# The output goes through pipes, because the machines need write-only descriptors and a terminal is not one.
exec 8> >(exec cat) && out=$!
exec 9> >(exec cat >&2) && err=$!

start=()
case $kind in
uml)
    # Its processes take turns, which costs a quarter less time on one processor.
    if command -v taskset >/dev/null; then start=(taskset -c "$(($(nproc) - 1))"); fi
    # Its terminals 1 and 2 are the command's stdout and stderr; init finds the folder by the name `shared`.
    start+=("$machine/linux" mem="${memory_mb}M" initrd="$machine/initrd.gz" quiet uml_dir="$shared"
        con=null "con0=null,fd:1" "con1=null,fd:8" "con2=null,fd:9" shared="$shared")
    ;;
qemu)
    # Opening /dev/kvm is not enough: without the processor's virtualisation it may exist and not run
    # this machine.
    accel=tcg cpu=max share=local,security_model=none,multidevs=remap
    if [ -w /dev/kvm ] && grep -qwE 'vmx|svm' /proc/cpuinfo; then accel=kvm cpu=host; fi
    # norandmaps: every process has its code at the same addresses, so that the emulation translates it once. A
    # jog, with its record, takes 4 s instead of 12.
    start+=("$machine/qemu-system-x86_64"
        -nodefaults -no-user-config -display none -no-reboot
        -machine q35 -accel "$accel" -cpu "$cpu" -smp "${VCAN_CPUS:-1}" -m "$memory_mb"
        -kernel "$machine/vmlinux" -initrd "$machine/initrd.gz"
        -append "console=ttyS0 quiet panic=-1 mitigations=off nokaslr norandmaps apparmor=0 audit=0 random.trust_cpu=on no_timer_check"
        -object "can-bus,id=wire" -device "kvaser_pci,canbus=wire"
        -serial "file:$shared/console" -device virtio-serial-pci
        -add-fd "fd=8,set=1" -chardev "file,id=out,path=/dev/fdset/1,append=on" -device "virtserialport,chardev=out,name=out"
        -add-fd "fd=9,set=2" -chardev "file,id=err,path=/dev/fdset/2,append=on" -device "virtserialport,chardev=err,name=err"
        -virtfs "$share,mount_tag=root,path=/,readonly=on" -virtfs "$share,mount_tag=shared,path=$shared")
    for i in "${!keep[@]}"; do start+=(-virtfs "$share,mount_tag=keep$i,path=${keep[i]}"); done
    ;;
esac

status=0
timeout --foreground --kill-after=5 "$limit_s" "${start[@]}" </dev/null >"$shared/output" 2>&1 || status=$?
exec 8>&- 9>&-
wait "$out" "$err"

if [ -s "$shared/status" ]; then exit "$(cat "$shared/status")"; fi
if [ "$status" = 124 ]; then
    echo "vcan: no end after $limit_s s, so the machine was stopped; VCAN_TIMEOUT_S sets the limit" >&2
    exit 124
fi
echo "vcan: the machine ended without the command's exit status (its own was $status). The end of its output:" >&2
tail -n 40 "$shared"/{output,console} >&2 || true
echo "vcan: if its files are damaged, remove $machine; if it cannot run here, try VCAN_GUEST=qemu" >&2
exit 125
