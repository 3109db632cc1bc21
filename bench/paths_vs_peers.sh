#!/usr/bin/env bash
# Times path tracing to equal noise: nuage against Mitsuba 3 and Blender's Cycles, on a cloud and on smoke.
#
#   bench/paths_vs_peers.sh [FOG.vdb [CHIMNEY.vdb]]
#
# Without files: a cloud that peers/fog_cloud.py makes, and a late frame of the chimney below ${NUAGE_DATA:-../shared}/data.
# Needs a Python 3.11 with `mitsuba`, `bpy` and `numpy` (PEERS_PYTHON, default python3), LLVM's shared library for one variant of
# Mitsuba, and Debian's python3-openvdb. ROUNDS (3), SIZE (256), THREADS (all) and SCENES ("fog g 0,chimney g 0.8", default all) are
# read from the environment. See README.md beside this file.
set -euo pipefail

cd_from=$PWD
root=$(cd "$(dirname "$0")/.." && pwd)
data=${NUAGE_DATA:-$root/../shared}/data
out=$root/out/bench/paths
python=${PEERS_PYTHON:-python3}

# shellcheck source=common.sh
source "$root/bench/common.sh"

"$python" -c 'import mitsuba, numpy' 2>/dev/null || fail "no Mitsuba for $python; pip install mitsuba, or set PEERS_PYTHON"
"$python" -c 'import bpy, os; os._exit(0)' 2>/dev/null || fail "no Blender for $python; pip install bpy==5.0.1 with Python 3.11"
/usr/bin/python3 -c 'import pyopenvdb' 2>/dev/null || fail "no OpenVDB for Python; apt-get install python3-openvdb"
if [ -z "${DRJIT_LIBLLVM_PATH:-}" ]; then
  DRJIT_LIBLLVM_PATH=$(find /usr/lib -name 'libLLVM*.so*' 2>/dev/null | sort -V | tail -n 1)
  [ -n "$DRJIT_LIBLLVM_PATH" ] || fail "no LLVM for Mitsuba; apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH"
  export DRJIT_LIBLLVM_PATH
fi

nuage=${NUAGE:-}
if [ -z "$nuage" ]; then
  (cd "$root" && cargo build --quiet --release -p nuage)
  target=${CARGO_TARGET_DIR:-target}
  case $target in /*) ;; *) target=$root/$target ;; esac
  nuage=$target/release/nuage
fi

fog=${1:-$out/fog_cloud.vdb}
[ $# -gt 0 ] || [ -f "$fog" ] || /usr/bin/python3 "$root/bench/peers/fog_cloud.py" "$fog"
mapfile -t files < <(absolute "$fog" "${2:-$data/sequences/chimney/fluid_data_0100.vdb}")
for file in "${files[@]}"; do
  [ -f "$file" ] || fail "no such file: $file (set NUAGE_DATA to the folder that holds data/)"
done
exec "$python" "$root/bench/peers/paths.py" "$nuage" /usr/bin/python3 "$out" "${files[@]}"
