#!/usr/bin/env bash
# Times reading every grid of a file, warm cache: nuage-vdb against OpenVDB's io::File without delayed loading.
#
#   bench/read_vs_openvdb.sh [FILE.vdb ...]
#
# Without files, reads the default list below ${NUAGE_DATA:-../shared}/data, and two of those files saved again by
# OpenVDB with each compression in full and half width. ROUNDS (3) rounds of REPEATS (7) reads each, the three readers
# taking turns. See README.md beside this file for how to read what it prints.
set -euo pipefail

cd_from=$PWD
root=$(cd "$(dirname "$0")/.." && pwd)
data=${NUAGE_DATA:-$root/../shared}/data
rounds=${ROUNDS:-3}
repeats=${REPEATS:-7}
out=$root/out/bench
packages=(libopenvdb-dev libtbb-dev libboost-dev) # libopenvdb-dev's headers use Boost's but do not pull them in.

default_files=(
  static/cumulus_half_f16_blosc
  static/bunny_fog200_f32_zip
  static/bunny_ls200_f16_zip
  static/dragon_ls1000_f16_blosc
  static/teapot_ls256_f16_none # uncompressed
  sequences/explosion/fluid_data_0030
)

fail() {
  echo "read_vs_openvdb: $*" >&2
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

# The value of key $1 in a reader's line $2.
field() { sed -n "s/.*\b$1=\([0-9.]*\).*/\1/p" <<<"$2"; }

# The median of the arguments.
median() {
  printf '%s\n' "$@" | sort -g |
    awk '{ v[NR] = $1 } END { m = int((NR + 1) / 2); print NR % 2 ? v[m] : (v[m] + v[m + 1]) / 2 }'
}

ratio() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.2f", a / b }'; }

command -v g++ >/dev/null || fail "no g++"
mkdir -p "$out"
if [ ! "$out/openvdb_read" -nt "$root/bench/openvdb_read.cc" ]; then
  require_openvdb
  g++ -std=c++17 -O2 "$root/bench/openvdb_read.cc" -o "$out/openvdb_read" -lopenvdb -ltbb -lImath
fi
if [ ! "$out/openvdb_resave" -nt "$root/bench/openvdb_resave.cc" ]; then
  require_openvdb
  g++ -std=c++17 -O2 "$root/bench/openvdb_resave.cc" -o "$out/openvdb_resave" -lopenvdb -ltbb -lImath
fi
if [ -z "${NUAGE_READ_TIME:-}" ]; then
  (cd "$root" && cargo build --quiet --release -p nuage-vdb --example read_time)
  target=${CARGO_TARGET_DIR:-target}
  case $target in /*) ;; *) target=$root/$target ;; esac
  NUAGE_READ_TIME=$target/release/examples/read_time
fi

files=()
if [ $# -gt 0 ]; then
  for file in "$@"; do
    case $file in /*) files+=("$file") ;; *) files+=("$cd_from/$file") ;; esac
  done
else
  for name in "${default_files[@]}"; do files+=("$data/$name.vdb"); done
  mkdir -p "$out/kinds"
  for name in cumulus_half_f16_blosc dragon_ls1000_f16_blosc; do
    for codec in blosc zip none; do
      for width in full half; do
        saved=$out/kinds/${name%%_*}_${codec}_$width.vdb
        [ -f "$saved" ] || "$out/openvdb_resave" "$data/static/$name.vdb" "$saved" "$codec" "$width"
        files+=("$saved")
      done
    done
  done
fi

cpu=$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1)
echo "$(date +%F) | ${cpu:-unknown processor} | $(nproc) cores | load $(cut -d' ' -f1 /proc/loadavg) |" \
  "OpenVDB $(sed -n 's/^#define OPENVDB_LIBRARY_VERSION_STRING *"\(.*\)"/\1/p' /usr/include/openvdb/version.h)" \
  "| $rounds rounds of $repeats reads, median of the rounds' medians, ms"
row='%-28s %7s %10s %10s %10s %8s %8s  %s\n'
# shellcheck disable=SC2059
printf "$row" file MB OpenVDB "nuage, 1t" nuage "ratio 1t" ratio compression

# The compression stands last: it is the only column with spaces.
for file in "${files[@]}"; do
  [ -f "$file" ] || fail "no such file: $file (set NUAGE_DATA to the folder that holds data/)"
  cat "$file" >/dev/null # warm
  peer=() ours_single=() ours=()
  for ((round = 0; round < rounds; round++)); do
    peer_line=$("$out/openvdb_read" "$file" "$repeats")
    peer+=("$(field median_ms "$peer_line")")
    ours_single+=("$(field median_ms "$(RAYON_NUM_THREADS=1 "$NUAGE_READ_TIME" "$file" "$repeats")")")
    ours_line=$("$NUAGE_READ_TIME" "$file" "$repeats")
    ours+=("$(field median_ms "$ours_line")")
  done
  peer_voxels=$(field active_voxels "$peer_line")
  our_voxels=$(field active_voxels "$ours_line")
  [ "$peer_voxels" = "$our_voxels" ] || fail "$file: $our_voxels active voxels read, OpenVDB reads $peer_voxels"
  p=$(median "${peer[@]}") s=$(median "${ours_single[@]}") o=$(median "${ours[@]}")
  megabytes=$(awk -v b="$(stat -c %s "$file")" 'BEGIN { printf "%.1f", b / 1e6 }')
  # shellcheck disable=SC2059
  printf "$row" "$(basename "$file" .vdb)" "$megabytes" "$p" "$s" "$o" "$(ratio "$p" "$s")" "$(ratio "$p" "$o")" \
    "${peer_line#*compression=}"
done
