#!/usr/bin/env bash
# Runs every check of the repository. Needs git, Rust and a C compiler; fetches the rest itself where it may.
#
#   ./test.sh
#
# Environment:
#   NUAGE_REQUIRE  comma list of data, gpu, openvdb: what must be there. Tests that lack something not listed are
#                  left out; tests that lack something listed fail.
#   NUAGE_DATA     folder with the real data and the oracle scenes (default: ../shared)
#   CI             if set, rustfmt and clippy must be there too
set -euo pipefail

root=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
cd "$root"

export NUAGE_REQUIRE=${NUAGE_REQUIRE:-}
export NUAGE_DATA=${NUAGE_DATA:-$(dirname "$root")/shared}

ran=()
left_out=()
current=

say() { printf '\n== %s\n' "$*"; }

requires() { [[ ",$NUAGE_REQUIRE," == *",$1,"* ]]; }

# A part that lacks something: the end if it is required, otherwise a line in the summary.
lacks() { # what, why, how to mend it
    if requires "$1"; then
        current="$1, which NUAGE_REQUIRE asks for: $2 ($3)"
        exit 1
    fi
    left_out+=("$1: $2 ($3)")
    say "left out: $1: $2"
}

stage() { # name, command...
    current=$1
    local start=$SECONDS
    say "$1"
    shift
    "$@"
    ran+=("$(printf '%4d s  %s' $((SECONDS - start)) "$current")")
    current=
}

summary() {
    local status=$?
    say "summary after $SECONDS s"
    if ((${#ran[@]})); then printf 'ran       %s\n' "${ran[@]}"; fi
    if ((${#left_out[@]})); then printf 'left out  %s\n' "${left_out[@]}"; fi
    if ((status)); then printf 'FAILED    %s\n' "${current:-set-up}"; else echo 'all passed'; fi
}
trap summary EXIT

# Whether Debian packages were installed; says why if not.
install_packages() {
    local as_root=()
    if ! command -v apt-get >/dev/null; then
        echo "no apt-get here to install: $*"
        return 1
    fi
    if ((EUID != 0)); then
        if ! sudo -n true 2>/dev/null; then
            echo "not allowed to install: $*"
            return 1
        fi
        as_root=(sudo -n)
    fi
    local apt=(env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120)
    say "installing $*"
    # A stale list of packages may still be good enough.
    ${as_root[@]+"${as_root[@]}"} "${apt[@]}" update || echo "the list of packages could not be refreshed"
    ${as_root[@]+"${as_root[@]}"} "${apt[@]}" install -y --no-install-recommends "$@" >/dev/null
}

has_openvdb() {
    command -v vdb_print >/dev/null && command -v nanovdb_validate >/dev/null &&
        /usr/bin/python3 -c 'import pyopenvdb' 2>/dev/null
}

has_vulkan() {
    local drivers=(/usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json)
    local loaders=(/usr/lib/*/libvulkan.so.1 /usr/lib*/libvulkan.so.1)
    local file found=0
    for file in "${drivers[@]}"; do if [[ -e $file ]]; then found=1; break; fi; done
    if ((!found)) && [[ -z ${VK_DRIVER_FILES:-} ]]; then return 1; fi
    for file in "${loaders[@]}"; do if [[ -e $file ]]; then return 0; fi; done
    return 1
}

has_component() { cargo "$1" --version >/dev/null 2>&1; }

# A component of the Rust toolchain, fetched if it is not there.
component() { # cargo command, rustup component
    has_component "$1" && return
    if command -v rustup >/dev/null && rustup component add "$2" && has_component "$1"; then return; fi
    if [[ -n ${CI:-} ]]; then
        current="$2, which a CI run needs, is not installed (rustup component add $2)"
        exit 1
    fi
    left_out+=("$2: not installed (rustup component add $2)")
    say "left out: $2 is not installed"
    return 1
}

# Set-up

for word in ${NUAGE_REQUIRE//,/ }; do
    case $word in
    data | gpu | openvdb) ;;
    *)
        current="NUAGE_REQUIRE names '$word'; it may name data, gpu and openvdb"
        exit 2
        ;;
    esac
done

if ! command -v cargo >/dev/null && [[ -f ${CARGO_HOME:-${HOME:-}/.cargo}/env ]]; then
    # shellcheck disable=SC1091
    source "${CARGO_HOME:-${HOME:-}/.cargo}/env"
fi
for tool in cargo cc; do
    if ! command -v "$tool" >/dev/null; then
        current="$tool is not on the PATH; install Rust (https://rustup.rs) and a C compiler (package gcc) first"
        exit 1
    fi
done

[[ -d $NUAGE_DATA/data ]] || lacks data "no folder data in $NUAGE_DATA" "set NUAGE_DATA"

has_openvdb || install_packages libopenvdb-tools libnanovdb-tools python3-openvdb || true
has_openvdb || lacks openvdb "no vdb_print, nanovdb_validate or pyopenvdb to compare with" \
    "install libopenvdb-tools, libnanovdb-tools and python3-openvdb"

if requires gpu && ! has_vulkan; then install_packages mesa-vulkan-drivers libvulkan1 || true; fi
has_vulkan || lacks gpu "no Vulkan driver" "install mesa-vulkan-drivers and libvulkan1"

# Checks

if component fmt rustfmt; then
    stage "formatting" cargo fmt --all --check
fi
if component clippy clippy; then
    stage "lints" cargo clippy --quiet --workspace --all-targets --features nuage/gpu -- -D warnings
fi
stage "tests" cargo test --quiet --workspace --features nuage/gpu
stage "documentation" env RUSTDOCFLAGS="-D warnings" cargo doc --quiet --workspace --no-deps
stage "tidy" cargo xtask tidy

wasm=wasm32-unknown-unknown
if [[ -d $(rustc --print sysroot)/lib/rustlib/$wasm/lib ]]; then
    stage "build for wasm" \
        cargo check --quiet -p nuage-vdb -p nuage-volume --no-default-features --target "$wasm"
else
    left_out+=("build for wasm: target not installed (rustup target add $wasm)")
fi
