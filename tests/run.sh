#!/usr/bin/env bash
# Every check of this repository, from a fresh Debian 12 with a Rust toolchain.
#
#   usage: tests/run.sh
#
# Installs what is missing (apt packages as root or with sudo; a Python environment under
# ~/.cache/needle-bench), then: shell scripts, formatting, licences where cargo-deny is there, the tests
# on real SocketCAN, in virtual machines where this kernel has no vcan, and all other tests. Clippy,
# documentation and the tests in virtual time run beside those in real time, which mostly wait, when the processors
# have nothing else to do. Stops at the
# first failure; one of what runs beside shows when its turn comes. With CI=true a test that lacks something fails.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PATH=$PATH:$HOME/.cargo/bin
# The same cases for every property each time: what fails here fails again. `cargo test` by hand
# draws new ones.
export PROPTEST_RNG_SEED=${PROPTEST_RNG_SEED:-1}

stage_name='' stage_start=0
# Of the commands that run beside the others: process group and output, by name.
declare -A group=() output=()
finish() {
    local status=$? leader
    for leader in "${group[@]}"; do kill -- "-$leader" 2>/dev/null || true; done
    if [ "$status" != 0 ]; then
        echo "tests/run.sh: FAILED at \"$stage_name\" after $((SECONDS - stage_start)) s (status $status), see above" >&2
    fi
}
trap finish EXIT

stage() { # name, command...
    stage_name=$1 stage_start=$SECONDS
    shift
    echo "==> $stage_name"
    "$@"
    echo "<== $stage_name: $((SECONDS - stage_start)) s"
}

fail() {
    echo "tests/run.sh: $*" >&2
    exit 1
}

# Command and the Debian package it is in.
declare -A package_of=(
    [cc]=build-essential [python3]=python3 [shellcheck]=shellcheck
    [candump]=can-utils [tshark]=tshark [ip]=iproute2 [modprobe]=kmod
    [tmux]=tmux [chrt]=util-linux [script]=bsdutils
)

install_packages() {
    local missing=() command apt=(env DEBIAN_FRONTEND=noninteractive apt-get)
    for command in "${!package_of[@]}"; do
        command -v "$command" >/dev/null || [ -x "/sbin/$command" ] || missing+=("${package_of[$command]}")
    done
    python3 -c 'import ensurepip' 2>/dev/null || missing+=(python3-venv)
    [ -e /usr/include/openigtlink/igtlSocket.h ] || missing+=(libopenigtlink-dev)
    [ ${#missing[@]} -gt 0 ] || return 0

    echo "missing: ${missing[*]}"
    [ "$(id -u)" = 0 ] || apt=(sudo -n "${apt[@]}")
    command -v apt-get >/dev/null ||
        fail "this is not Debian; install by other means: ${missing[*]}"
    [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null ||
        fail "not root, and sudo wants a password; run: sudo apt-get update && sudo apt-get install ${missing[*]}"
    "${apt[@]}" update -qq
    "${apt[@]}" install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
}

check_toolchain() {
    command -v cargo >/dev/null ||
        fail "no cargo; install Rust from https://rustup.rs, then try again"
    cargo --version
    if ! cargo fmt --version || ! cargo clippy --version; then
        fail "rustup component add rustfmt clippy, then try again"
    fi
}

# Kept as long as its requirements stay the same.
prepare_python() {
    local venv=${XDG_CACHE_HOME:-$HOME/.cache}/needle-bench/venv
    local requirements=tests/peers/requirements.txt python
    if ! cmp -s "$requirements" "$venv/installed.txt" || ! "$venv/bin/python" -c ''; then
        # The interpreter itself: a shim in front of it costs 10 s a start in the machine.
        python=$(python3 -c 'import os, sys; print(os.path.realpath(sys.executable))')
        rm -rf "$venv"
        "$python" -m venv "$venv"
        "$venv/bin/pip" install --quiet --disable-pip-version-check -r "$requirements"
        cp "$requirements" "$venv/installed.txt"
    fi
    export NEEDLE_PEERS_PYTHON=$venv/bin/python
    "$NEEDLE_PEERS_PYTHON" --version
}

# The reference library's own example programs: Debian has their source as documentation, which an
# image may leave out, so the package is unpacked here.
prepare_openigtlink() {
    local folder=${XDG_CACHE_HOME:-$HOME/.cache}/needle-bench/openigtlink source program
    local programs=(
        Tracker/TrackerServer2 TrackingData/TrackingDataServer Status/StatusServer
        QuaternionTrackingData/QuaternionTrackingDataServer Receiver/ReceiveClient
    )
    for program in "${programs[@]}"; do
        [ -x "$folder/${program#*/}" ] && continue
        source=$folder/source
        if [ ! -d "$source" ]; then
            mkdir -p "$folder"
            (cd "$folder" && apt-get download -qq openigtlink-examples)
            dpkg-deb -x "$folder"/openigtlink-examples_*.deb "$source"
        fi
        c++ -w -I/usr/include/openigtlink -o "$folder/${program#*/}" \
            "$source/usr/share/doc/openigtlink-examples/examples/$program.cxx" -lOpenIGTLink -pthread
    done
    export NEEDLE_PEERS_OPENIGTLINK=$folder
    echo "${#programs[@]} programs in $folder"
}

check_scripts() {
    shellcheck tests/run.sh .ci/run vcan/run.sh vcan/guest/run.sh vcan/guest/prepare.sh
    shellcheck --shell=dash vcan/guest/init
}

check_licences() {
    if cargo deny --version 2>/dev/null; then
        cargo deny --all-features check licenses bans
    else
        echo 'SKIPPED: no cargo-deny; cargo install --locked cargo-deny (the workflow on GitHub has it)'
    fi
}

# A clone dates its files by the cloning, and cargo builds crates in vendor, and those above them, anew if their
# files are younger than the build. Files of the same content get back the date that they had at the build.
date_vendored_crates() {
    local stamp=${CARGO_TARGET_DIR:-target}/vendor.tree tree
    git diff --quiet HEAD -- vendor 2>/dev/null || return 0
    tree=$(git rev-parse HEAD:vendor)
    if [ "$(cat "$stamp" 2>/dev/null)" != "$tree" ]; then
        mkdir -p "$(dirname "$stamp")"
        echo "$tree" >"$stamp"
    fi
    find vendor -exec touch -r "$stamp" {} +
}

# In a folder of its own, since cargo lets one command at a time into a folder.
lint() {
    export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-target}/lint
    cargo clippy --all-targets -- -D warnings
    RUSTDOCFLAGS='-D warnings' cargo doc --no-deps
}

# `guest` is set if the tests need a virtual machine. Where a kernel cannot run as a program, an emulated computer can.
prepare_vcan() {
    ask_for_guest && return
    echo 'trying an emulated computer, which is several times slower'
    export VCAN_GUEST=qemu
    ask_for_guest
}

ask_for_guest() {
    # printenv's 1: there is no such variable, so this kernel has vcan.
    guest=$(vcan/run.sh printenv NEEDLE_GUEST) || [ $? = 1 ]
}

test_on_vcan() { # test...
    local host runner
    host=$(rustc -vV | sed -n 's/^host: //p')
    runner=CARGO_TARGET_$(tr a-z- A-Z_ <<<"$host")_RUNNER
    # In an emulated computer, a processor for each side of the bus.
    env "$runner=$PWD/vcan/run.sh" VCAN_CPUS=2 VCAN_TIMEOUT_S=1800 \
        cargo test --test vcan -- "$@"
}

# Only the emulated computer has a CAN controller.
test_controller() {
    VCAN_GUEST=qemu test_on_vcan preflight
}

# What needs time but is in no hurry: it runs only where nothing else wants to.
test_when_idle() {
    chrt --idle --pid 0 "$BASHPID"
    cargo test --test pure
    cargo test --doc
    lint
}

# Starts a command in a process group of its own, which ends with this script.
begin() { # name, command...
    output[$1]=$(mktemp)
    set -m
    ("${@:2}") </dev/null >"${output[$1]}" 2>&1 &
    group[$1]=$!
    set +m
}

# Waits for a command that was begun.
end() { # name
    local status=0
    wait "${group[$1]}" || status=$?
    unset "group[$1]"
    cat "${output[$1]}"
    rm "${output[$1]}"
    return "$status"
}

# Six of the tests in real time share two processors. They record their runs in memory where it has room: a disk that
# others keep busy for 5 s ends a recorded run, as it should.
test_on_host() {
    local folder=${TMPDIR:-/tmp} room_kb
    room_kb=$(df -k --output=avail /dev/shm 2>/dev/null | tail -n 1) || room_kb=0
    [ "$room_kb" -lt 2000000 ] || folder=/dev/shm
    cargo test --lib --bins
    TMPDIR=$folder cargo test --test live -- --test-threads=6
}

stage 'system packages' install_packages
stage 'Rust toolchain' check_toolchain
stage 'Python peers' prepare_python
stage 'OpenIGTLink peers' prepare_openigtlink
stage 'shell scripts' check_scripts
stage 'formatting' cargo fmt --check
stage 'licences' check_licences
stage 'vcan' prepare_vcan
stage 'dates of the vendored crates' date_vendored_crates
stage 'build of the tests' cargo test --no-run
begin idle test_when_idle
# One after the other: beside the tests on the host the machine held a bench on vcan up for 4.5 s.
stage 'tests on vcan' test_on_vcan
stage 'tests on the host' test_on_host
[ -z "$guest" ] || stage 'tests on an emulated CAN controller' test_controller
stage 'tests in virtual time, clippy and documentation' end idle
echo "tests/run.sh: all passed in $SECONDS s"
