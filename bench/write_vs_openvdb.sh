#!/usr/bin/env bash
# Times writing every grid of a file: nuage-vdb to memory against OpenVDB's io::File to a file in memory.
#
#   bench/write_vs_openvdb.sh [FILE.vdb ...]
#
# Without files, writes those of the default list below ${NUAGE_DATA:-../shared}/data, with Blosc and with ZIP, as
# full floats (WIDTH=half: as half floats). ROUNDS (3) rounds of REPEATS (3) writes each, the three writers taking
# turns. See README.md beside this file for how to read what it prints.
set -euo pipefail

cd_from=$PWD
root=$(cd "$(dirname "$0")/.." && pwd)
data=${NUAGE_DATA:-$root/../shared}/data
rounds=${ROUNDS:-3}
repeats=${REPEATS:-3}
out=$root/out/bench
packages=(libopenvdb-dev libtbb-dev libboost-dev) # libopenvdb-dev's headers use Boost's but do not pull them in.

default_files=(
  static/dragon_ls1000_f16_blosc
  static/cumulus_half_f16_blosc
)
width=${WIDTH:-full}
folder=${MEMORY_FOLDER:-/dev/shm}

fail() {
  echo "write_vs_openvdb: $*" >&2
  exit 1
}

# Installs OpenVDB's headers from Debian if they are absent and this user may; otherwise says how.
require_openvdb() {
  local probe='#include <openvdb/openvdb.h>'
  echo "$probe" | g++ -std=c++17 -x c++ -fsyntax-only - 2>/dev/null && return
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "OpenVDB's headers are absent; running: apt-get install ${packages[*]}" >&2
    apt-get install -y --no-install-recommends "${packages[@]}" >/dev/null || true
  fi
  echo "$probe" | g++ -std=c++17 -x c++ -fsyntax-only - 2>/dev/null ||
    fail "no OpenVDB headers; install them as root with: apt-get install ${packages[*]}"
}

# The value of key $1 in a writer's line $2.
field() { sed -n "s/.*\b$1=\([0-9.]*\).*/\1/p" <<<"$2"; }

# The median of the arguments.
median() {
  printf '%s\n' "$@" | sort -g |
    awk '{ v[NR] = $1 } END { m = int((NR + 1) / 2); print NR % 2 ? v[m] : (v[m] + v[m + 1]) / 2 }'
}

ratio() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.2f", a / b }'; }

command -v g++ >/dev/null || fail "no g++"
mkdir -p "$out"
if [ ! "$out/openvdb_write" -nt "$root/bench/openvdb_write.cc" ]; then
  require_openvdb
  g++ -std=c++17 -O2 "$root/bench/openvdb_write.cc" -o "$out/openvdb_write" -lopenvdb -ltbb -lImath
fi
if [ -z "${NUAGE_WRITE_TIME:-}" ]; then
  (cd "$root" && cargo build --quiet --release -p nuage-vdb --example write_time)
  target=${CARGO_TARGET_DIR:-target}
  case $target in /*) ;; *) target=$root/$target ;; esac
  NUAGE_WRITE_TIME=$target/release/examples/write_time
fi

files=()
if [ $# -gt 0 ]; then
  for file in "$@"; do
    case $file in /*) files+=("$file") ;; *) files+=("$cd_from/$file") ;; esac
  done
else
  for name in "${default_files[@]}"; do files+=("$data/$name.vdb"); done
fi

cpu=$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1)
echo "$(date +%F) | ${cpu:-unknown processor} | $(nproc) cores | load $(cut -d' ' -f1 /proc/loadavg) |" \
  "OpenVDB $(sed -n 's/^#define OPENVDB_LIBRARY_VERSION_STRING *"\(.*\)"/\1/p' /usr/include/openvdb/version.h)" \
  "| $rounds rounds of $repeats writes, $width floats, median of the rounds' medians, ms"
row='%-26s %-6s %10s %10s %10s %8s %8s %10s %10s\n'
# shellcheck disable=SC2059
printf "$row" file codec OpenVDB "nuage, 1t" nuage "ratio 1t" ratio "MB theirs" "MB ours"

for file in "${files[@]}"; do
  [ -f "$file" ] || fail "no such file: $file (set NUAGE_DATA to the folder that holds data/)"
  for codec in blosc zip; do
    peer=() ours_single=() ours=()
    for ((round = 0; round < rounds; round++)); do
      peer_line=$("$out/openvdb_write" "$file" "$codec" "$width" "$repeats" "$folder")
      peer+=("$(field median_ms "$peer_line")")
      ours_single+=("$(field median_ms "$(RAYON_NUM_THREADS=1 "$NUAGE_WRITE_TIME" "$file" "$codec" "$width" "$repeats")")")
      ours_line=$("$NUAGE_WRITE_TIME" "$file" "$codec" "$width" "$repeats")
      ours+=("$(field median_ms "$ours_line")")
    done
    peer_voxels=$(field active_voxels "$peer_line")
    our_voxels=$(field active_voxels "$ours_line")
    [ "$peer_voxels" = "$our_voxels" ] || fail "$file: $our_voxels active voxels written, OpenVDB writes $peer_voxels"
    p=$(median "${peer[@]}") s=$(median "${ours_single[@]}") o=$(median "${ours[@]}")
    megabytes() { awk -v b="$(field bytes "$1")" 'BEGIN { printf "%.2f", b / 1e6 }'; }
    # shellcheck disable=SC2059
    printf "$row" "$(basename "$file" .vdb)" "$codec" "$p" "$s" "$o" "$(ratio "$p" "$s")" "$(ratio "$p" "$o")" \
      "$(megabytes "$peer_line")" "$(megabytes "$ours_line")"
  done
done
