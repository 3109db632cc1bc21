#!/usr/bin/env bash
# Times kernels over the rays of one picture: nuage-render against NanoVDB's own traversal and samplers.
#
#   bench/rays_vs_nanovdb.sh [FOG.vdb [LEVEL_SET.vdb]]
#
# Without files: the cumulus and the dragon below ${NUAGE_DATA:-../shared}/data/static. ROUNDS (3) rounds of REPEATS (3) pictures of
# SIZE (1024) squared, programs and kernels taking turns, on one thread and on two. NanoVDB runs each kernel in two ways, over the
# whole box and over spans of leaves; the faster one counts. Pictures are compared too. See README.md beside this file.
set -euo pipefail

cd_from=$PWD
root=$(cd "$(dirname "$0")/.." && pwd)
data=${NUAGE_DATA:-$root/../shared}/data
rounds=${ROUNDS:-3}
repeats=${REPEATS:-3}
size=${SIZE:-1024}
out=$root/out/bench

# shellcheck source=common.sh
source "$root/bench/common.sh"

require_nanovdb() {
  local probe='#include <nanovdb/NanoVDB.h>'
  echo "$probe" | g++ -std=c++17 -x c++ -fsyntax-only - 2>/dev/null && command -v nanovdb_convert >/dev/null && return
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get install -y --no-install-recommends libnanovdb-dev libnanovdb-tools >/dev/null || true
  fi
  command -v nanovdb_convert >/dev/null ||
    fail "no NanoVDB; install it as root with: apt-get install libnanovdb-dev libnanovdb-tools"
}

require_nanovdb
peer=$out/nanovdb_rays
[ "$peer" -nt "$root/bench/peers/nanovdb_rays.cc" ] ||
  g++ -std=c++17 -O3 -march=native -DNDEBUG -pthread "$root/bench/peers/nanovdb_rays.cc" -o "$peer"
(cd "$root" && cargo build --quiet --release -p nuage-render --example rays)
target=${CARGO_TARGET_DIR:-target}
case $target in /*) ;; *) target=$root/$target ;; esac
ours=$target/release/examples/rays

mapfile -t files < <(absolute "${1:-$data/static/cumulus_half_f16_blosc.vdb}" "${2:-$data/static/dragon_ls1000_f16_blosc.vdb}")
for file in "${files[@]}"; do
  [ -f "$file" ] || fail "no such file: $file (set NUAGE_DATA to the folder that holds data/)"
  nvdb=$out/$(basename "$file" .vdb).nvdb
  [ "$nvdb" -nt "$file" ] || nanovdb_convert -f "$file" "$nvdb" >/dev/null
done

# Peak signal to noise of two pictures, in decibels.
psnr() {
  paste <(od -An -v -w4 -t f4 "$1") <(od -An -v -w4 -t f4 "$2") | awk '
    { d = $1 - $2; sum += d * d; if ($2 > peak) peak = $2 }
    END { printf "%.1f", (sum > 0 ? 10 * log(peak * peak * NR / sum) / log(10) : 999) }'
}

cpu=$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1)
version=$(dpkg-query -W -f '${Version}' libnanovdb-dev 2>/dev/null || echo unknown)
echo "$(date +%F) | ${cpu:-unknown processor} | $(nproc) cores | load $(cut -d' ' -f1 /proc/loadavg) |" \
  "NanoVDB $version, $(g++ -dumpfullversion) -O3 -march=native | $(rustc --version | cut -d' ' -f1,2) |" \
  "${size}², $rounds rounds of $repeats, medians of wall ms; CPU ms of all threads in brackets"
row='%-16s %7s %20s %20s %20s %8s %8s %8s\n'
# shellcheck disable=SC2059
printf "$row" kernel threads 'NanoVDB, box' 'NanoVDB, spans' nuage ratio 'CPU' PSNR

# One kernel of both programs: our name, the peer's two names (or one twice), the file.
compare() {
  local kernel=$1 box=$2 spans=$3 file=$4 nvdb threads round line
  nvdb=$out/$(basename "$file" .vdb).nvdb
  for threads in 1 2; do
    local box_ms=() spans_ms=() our_ms=() box_cpu=() spans_cpu=() our_cpu=()
    for ((round = 0; round < rounds; round++)); do
      line=$("$peer" "$nvdb" "$box" "$threads" "$repeats" "$size" "$out/box.f32")
      box_ms+=("$(field median_ms "$line")") box_cpu+=("$(field cpu_ms "$line")")
      if [ "$spans" = "$box" ]; then
        spans_ms=("${box_ms[@]}") spans_cpu=("${box_cpu[@]}")
      else
        line=$("$peer" "$nvdb" "$spans" "$threads" "$repeats" "$size" "$out/spans.f32")
        spans_ms+=("$(field median_ms "$line")") spans_cpu+=("$(field cpu_ms "$line")")
      fi
      line=$("$ours" "$file" "$kernel" "$threads" "$repeats" "$size" "$out/ours.f32")
      our_ms+=("$(field median_ms "$line")") our_cpu+=("$(field cpu_ms "$line")")
    done
    local b s o bc sc oc best best_cpu
    b=$(median "${box_ms[@]}") s=$(median "${spans_ms[@]}") o=$(median "${our_ms[@]}")
    bc=$(median "${box_cpu[@]}") sc=$(median "${spans_cpu[@]}") oc=$(median "${our_cpu[@]}")
    best=$(printf '%s\n' "$b" "$s" | sort -g | head -n 1)
    best_cpu=$(printf '%s\n' "$bc" "$sc" | sort -g | head -n 1)
    # shellcheck disable=SC2059
    printf "$row" "$kernel" "$threads" "$b ($bc)" "$s ($sc)" "$o ($oc)" "$(ratio "$best" "$o")" \
      "$(ratio "$best_cpu" "$oc")" "$(psnr "$out/ours.f32" "$out/box.f32")"
  done
}

for kernel in nearest trilinear exact cubic track; do
  compare "$kernel" "$kernel" "$kernel-spans" "${files[0]}"
done
compare voxel-shaded surface-shaded surface-shaded "${files[1]}"
# The interpolated surface and its slope are more than the peer finds, so that its picture is another one.
compare surface-shaded surface-shaded surface-shaded "${files[1]}"

# Delta tracking is held against the peer's by means of blocks over independent pictures.
pictures=64
side=128
block_means() {
  od -An -v -w4 -t f4 "$1" | awk -v side="$side" '
    { i = NR - 1; sum[int(int(i / side) / 8) * (side / 8) + int(i % side / 8)] += $1 }
    END { for (b = 0; b < side * side / 64; b++) printf "%.9g ", sum[b] / 64; print "" }'
}
nvdb=$out/$(basename "${files[0]}" .vdb).nvdb
: >"$out/ours.blocks" && : >"$out/peer.blocks"
for ((seed = 1; seed <= pictures; seed++)); do
  "$ours" "${files[0]}" track 1 1 "$side" "$out/ours.f32" "$seed" >/dev/null
  "$peer" "$nvdb" track-spans 1 1 "$side" "$out/peer.f32" "$seed" >/dev/null
  block_means "$out/ours.f32" >>"$out/ours.blocks"
  block_means "$out/peer.f32" >>"$out/peer.blocks"
done
awk -v n="$pictures" -v side="$side" '
  { f = FILENAME ~ /peer/; for (b = 1; b <= NF; b++) { sum[f, b] += $b; squares[f, b] += $b * $b } }
  END {
    for (b = 1; b <= NF; b++) {
      error = 0
      for (f = 0; f < 2; f++) { mean[f] = sum[f, b] / n; error += (squares[f, b] / n - mean[f] ^ 2) / (n - 1) }
      # Where all pictures have the same, both are to have it.
      if (error <= 0 && mean[0] == mean[1]) continue
      z = error > 0 ? (mean[0] - mean[1]) / sqrt(error) : 99
      if (z < 0) z = -z
      if (z < 3) within++
      if (z > most) most = z
      blocks++; ours += mean[0]; peer += mean[1]
    }
    printf "track, %d pictures of %d² each: %d of %d blocks of 8² within 3 standard errors, the largest %.2f; all together %.5f times the peer\n",
      n, side, within, blocks, most, ours / peer
  }' "$out/ours.blocks" "$out/peer.blocks"
