#!/usr/bin/env bash
# Runs a command with the virtual CAN interfaces vcan0 and vcan1 up.
#
#   usage: vcan/run.sh [--keep DIR]... COMMAND [ARGUMENT]...
#
# If this kernel has vcan, the script brings the interfaces up (as root, or with sudo without a
# password) and runs the command here. Otherwise it runs it in a virtual machine with Debian's
# kernel, see vcan/guest/run.sh. In both cases the command sees this machine's files, working folder
# and environment, and the script passes its output and exit status on. NEEDLE_VCAN=1 tells the
# command's tests that a missing interface is a failure.
#
#   --keep DIR       in the virtual machine, files written in DIR are kept; all others are lost
#   VCAN_TIMEOUT_S   time limit, 300 by default; exit status 124 when it is exceeded
#   VCAN_GUEST       uml or qemu: use that virtual machine even if this kernel has vcan
#
# As Cargo's runner it lets tests be built here and run in the machine:
#   CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER=$PWD/vcan/run.sh cargo test --test vcan
set -euo pipefail
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)

as_root=()
[ "$(id -u)" = 0 ] || as_root=(sudo -n)

is_up() {
    local flags
    flags=$(cat "/sys/class/net/$1/flags" 2>/dev/null) && ((flags & 1))
}

bring_up() {
    is_up "$1" && return
    [ -e "/sys/class/net/$1" ] || {
        "${as_root[@]}" modprobe vcan || true # may be built in
        "${as_root[@]}" ip link add dev "$1" type vcan
    } && "${as_root[@]}" ip link set "$1" up
    is_up "$1"
}

if [ -z "${VCAN_GUEST:-}" ]; then
    if why_not=$({ bring_up vcan0 && bring_up vcan1; } 2>&1); then
        while [ "${1:-}" = --keep ]; do shift 2; done
        export NEEDLE_VCAN=1
        exec timeout --foreground --kill-after=5 "${VCAN_TIMEOUT_S:-300}" "$@"
    fi
    echo "vcan: not on this kernel (${why_not##*$'\n'}), so in a virtual machine" >&2
fi
exec "$here/guest/run.sh" "$@"
