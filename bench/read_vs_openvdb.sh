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

default_files=(
  static/cumulus_half_f16_blosc
  static/bunny_fog200_f32_zip
  static/bunny_ls200_f16_zip
  static/dragon_ls1000_f16_blosc
  static/teapot_ls256_f16_none # uncompressed
  sequences/explosion/fluid_data_0030
)

# shellcheck source=common.sh
source "$root/bench/common.sh"
build_peer openvdb_read
build_peer openvdb_resave
[ -n "${NUAGE_READ_TIME:-}" ] || NUAGE_READ_TIME=$(build_example read_time)

files=()
if [ $# -gt 0 ]; then
  mapfile -t files < <(absolute "$@")
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
