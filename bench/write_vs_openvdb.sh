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

default_files=(
  static/dragon_ls1000_f16_blosc
  static/cumulus_half_f16_blosc
)
width=${WIDTH:-full}
folder=${MEMORY_FOLDER:-/dev/shm}

# shellcheck source=common.sh
source "$root/bench/common.sh"
build_peer openvdb_write
[ -n "${NUAGE_WRITE_TIME:-}" ] || NUAGE_WRITE_TIME=$(build_example write_time)

files=()
if [ $# -gt 0 ]; then
  mapfile -t files < <(absolute "$@")
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
