#!/usr/bin/env bash
# Times the GPU renderer against NanoVDB's PNanoVDB.h on one device: the same grid, rays and step, in turns in one process.
#
#   bench/gpu_vs_pnanovdb.sh [FOG.vdb [LEVEL_SET.vdb]]
#
# Without files: out/bench/fog_cloud.vdb, which peers/fog_cloud.py makes, and the bunny below ${NUAGE_DATA:-../shared}/data/static.
# REPEATS (9) pictures of SIZE (512) squared. Then, where RADV is installed, what it makes of both sides' shaders for FAMILIES
# ("NAVI21 GFX1100"). See README.md beside this file.
set -euo pipefail

cd_from=$PWD
root=$(cd "$(dirname "$0")/.." && pwd)
data=${NUAGE_DATA:-$root/../shared}/data
repeats=${REPEATS:-9}
size=${SIZE:-512}
out=$root/out/bench
export XDG_RUNTIME_DIR=${XDG_RUNTIME_DIR:-/tmp}

# shellcheck source=common.sh
source "$root/bench/common.sh"

command -v glslangValidator >/dev/null && command -v spirv-opt >/dev/null && command -v nanovdb_convert >/dev/null &&
  [ -f /usr/include/nanovdb/PNanoVDB.h ] ||
  fail "install as root: apt-get install glslang-tools spirv-tools libnanovdb-dev libnanovdb-tools mesa-vulkan-drivers"

for kernel in SURFACE NEAREST_BOX NEAREST_SPANS NEAREST_WALK TRILINEAR_SPANS; do
  glslangValidator -V --target-env vulkan1.1 "-DKERNEL=$kernel" -I/usr/include/nanovdb \
    "$root/bench/peers/pnanovdb.comp" -o "$out/$kernel.spv" >/dev/null
  spirv-opt -O "$out/$kernel.spv" -o "$out/$kernel.spv"
done
# What is timed is the device's code; the profile of this program matters only while it reads files.
(cd "$root" && cargo build --quiet -p nuage-gpu --example rays && { [ -n "${NUAGE:-}" ] || cargo build --quiet --release -p nuage; })
(cd "$root" && cargo build --quiet -p xtask --features isa)
target=${CARGO_TARGET_DIR:-target}
case $target in /*) ;; *) target=$root/$target ;; esac
rays=$target/debug/examples/rays

mapfile -t files < <(absolute "${1:-$out/fog_cloud.vdb}" "${2:-$data/static/bunny_ls200_f16_zip.vdb}")
for file in "${files[@]}"; do
  [ -f "$file" ] || fail "no such file: $file"
  name=$out/$(basename "$file" .vdb)
  [ "$name.nvdb" -nt "$file" ] || nanovdb_convert -f "$file" "$name.nvdb" >/dev/null
  # Uniform codes of four and of eight bits: two look-ups of eight need no more than one word.
  for codec in u4 u8; do
    "${NUAGE:-$target/release/nuage}" convert "$file" "$name.$codec.nuage" --codec "$codec" --force >"$name.$codec.txt" 2>&1 ||
      fail "$(cat "$name.$codec.txt")"
  done
done

cpu=$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1)
version() { dpkg-query -W -f '${Version}' "$1" 2>/dev/null || echo unknown; }
echo "$(date +%F) | ${cpu:-unknown processor} | $(nproc) cores | load $(cut -d' ' -f1 /proc/loadavg) |" \
  "Mesa $(version mesa-vulkan-drivers), NanoVDB $(version libnanovdb-dev), glslang $(version glslang-tools) |" \
  "$(rustc --version | cut -d' ' -f1,2) | ${size}², medians of $repeats; ms of all processors, wall ms in brackets"
row='%-24s %-6s %-16s %18s %18s %7s %9s %9s %7s %7s\n'
# shellcheck disable=SC2059
printf "$row" grid bricks kernel PNanoVDB nuage ratio 'MB peer' 'MB nuage' memory PSNR

# Our form, the kernel, the peer's kernel, the file: one row.
compare() {
  local form=$1 kernel=$2 shader=$3 file=$4 ours name line
  name=$out/$(basename "$file" .vdb)
  ours=$file
  [ "$form" = f32 ] || ours=$name.$form.nuage
  line=$("$rays" "$ours" "$name.nvdb" "$kernel" "$out/$shader.spv" "$repeats" "$size" "$out/nuage_${shader}_$form.wgsl")
  local p o
  p=$(field peer_cpu_ms "$line") o=$(sed -n 's/.* cpu_ms=\([0-9.]*\).*/\1/p' <<<"$line")
  # shellcheck disable=SC2059
  printf "$row" "$(basename "$name")" "$form" "$shader" "$p ($(field peer_wall_ms "$line"))" "$o ($(field wall_ms "$line"))" \
    "$(ratio "$p" "$o")" "$(awk -v b="$(field peer_bytes "$line")" 'BEGIN { printf "%.2f", b / 1e6 }')" \
    "$(awk -v b="$(sed -n 's/.* bytes=\([0-9]*\).*/\1/p' <<<"$line")" 'BEGIN { printf "%.2f", b / 1e6 }')" \
    "$(ratio "$(sed -n 's/.* bytes=\([0-9]*\).*/\1/p' <<<"$line")" "$(field peer_bytes "$line")")" "$(field psnr "$line")"
  [ "$kernel" != surface ] ||
    echo "  depths within 0.1 voxel: $(field within "$line") of $(field both "$line"); met by one side alone: $(field one_sided "$line")"
  [ "$kernel $form" != "surface f32" ] ||
    echo "  of the others a walk in double precision agrees with ours in $(field right "$line"), with the peer's in $(field peer_right "$line")"
}

for form in f32 u8 u4; do
  compare "$form" nearest NEAREST_SPANS "${files[0]}"
done
compare f32 nearest NEAREST_WALK "${files[0]}"
compare f32 nearest NEAREST_BOX "${files[0]}"
for form in ${TRILINEAR-f32 u8}; do
  compare "$form" trilinear TRILINEAR_SPANS "${files[0]}"
done
for form in f32 u8; do
  compare "$form" surface SURFACE "${files[1]}"
done
march_size=$((size / 4))
for form in f32 u8; do
  ours=${files[0]}
  [ "$form" = f32 ] || ours=$out/$(basename "$ours" .vdb).$form.nuage
  line=$("$rays" "$ours" - march - "$repeats" "$march_size" "$out/nuage_MARCH_$form.wgsl")
  echo "ray marcher, ${march_size}², $form: $(field cpu_ms "$line") ($(field wall_ms "$line"))"
done
for file in "${files[@]}"; do
  for codec in u4 u8; do
    echo "$(basename "$file" .vdb), $codec: $(grep -o '[0-9.]* dB' "$out/$(basename "$file" .vdb).$codec.txt" | head -n 1)"
  done
done

radv=/usr/share/vulkan/icd.d/radeon_icd.x86_64.json
[ -f "$radv" ] || exit 0
for family in ${FAMILIES-NAVI21 GFX1100}; do
  shaders=()
  for kernel in SURFACE NEAREST_SPANS NEAREST_WALK TRILINEAR_SPANS; do
    [ ! -f "$out/nuage_${kernel}_f32.wgsl" ] || shaders+=("$out/nuage_${kernel}_f32.wgsl" "$out/$kernel.spv")
  done
  shaders+=("$out/nuage_MARCH_f32.wgsl" "$out/nuage_MARCH_u8.wgsl")
  VK_DRIVER_FILES=$radv RADV_FORCE_FAMILY=$family MESA_SHADER_CACHE_DISABLE=true \
    "$target/debug/xtask" bench isa "${shaders[@]}" 2>/dev/null
done
