#!/usr/bin/env bash
# All comparisons of the renderer, one after the other: what a ray costs, rays against NanoVDB, paths against Mitsuba 3 and
# Cycles, pictures against vdb_render.
#
#   bench/render.sh [RECORD.md]
#
# Prints the tables of each, with the versions of the peers, and writes them to RECORD.md as well (bench/records/DATE-render.md
# unless said). What cannot run for want of a peer is said and left out, and the script then fails. What each reads from the
# environment stands at its top. Takes an hour or two on two cores; nothing else should run.
set -euo pipefail

root=$(cd "$(dirname "$0")/.." && pwd)
record=${1:-$root/bench/records/$(date +%F)-render.md}
[ ! -e "$record" ] || { echo "render: $record is there already" >&2; exit 1; }
lines=$(mktemp)
trap 'rm -f "$lines"' EXIT
left_out=0

# One comparison: its title and its command. The fences are for the record.
part() {
  local title=$1
  shift
  printf '\n## %s\n\n```\n' "$title" | tee -a "$lines"
  if ! (cd "$root" && "$@") | tee -a "$lines"; then
    echo "left out: ${*} failed" | tee -a "$lines"
    left_out=1
  fi
  printf '```\n' | tee -a "$lines"
}

{
  echo "# The renderer and its peers, $(date +%F)"
  echo
  echo "$(sed -n 's/^model name[^:]*: *//p' /proc/cpuinfo 2>/dev/null | head -n 1), $(nproc) cores, load" \
    "$(cut -d' ' -f1 /proc/loadavg 2>/dev/null), $(rustc --version), commit $(git -C "$root" rev-parse --short HEAD)."
} | tee -a "$lines"
part 'What a ray costs' cargo bench --quiet -p nuage-render --bench cost
part 'Rays against NanoVDB' bench/rays_vs_nanovdb.sh
part 'Paths against Mitsuba 3 and Cycles' bench/paths_vs_peers.sh
part 'Pictures against vdb_render' bench/render_vs_vdb_render.py
cp "$lines" "$record"
echo "written: $record"
exit "$left_out"
