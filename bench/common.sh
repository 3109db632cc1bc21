# What read_vs_openvdb.sh and write_vs_openvdb.sh share; they source it after setting root and out.
# shellcheck shell=bash

fail() {
  echo "$(basename "$0" .sh): $*" >&2
  exit 1
}

packages=(libopenvdb-dev libtbb-dev libboost-dev) # libopenvdb-dev's headers use Boost's but do not pull them in.

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

# The value of key $1 in a program's line $2.
field() { sed -n "s/.*\b$1=\([0-9.]*\).*/\1/p" <<<"$2"; }

# The median of the arguments.
median() {
  printf '%s\n' "$@" | sort -g |
    awk '{ v[NR] = $1 } END { m = int((NR + 1) / 2); print NR % 2 ? v[m] : (v[m] + v[m + 1]) / 2 }'
}

ratio() { awk -v a="$1" -v b="$2" 'BEGIN { printf "%.2f", a / b }'; }

# Builds the C++ program $1 of this folder into $out, if its source is newer.
build_peer() {
  [ ! "$out/$1" -nt "$root/bench/$1.cc" ] || return 0
  require_openvdb
  g++ -std=c++17 -O2 "$root/bench/$1.cc" -o "$out/$1" -lopenvdb -ltbb -lImath
}

# Builds the example $1 of nuage-vdb and prints its path.
build_example() {
  (cd "$root" && cargo build --quiet --release -p nuage-vdb --example "$1")
  local target=${CARGO_TARGET_DIR:-target}
  case $target in /*) ;; *) target=$root/$target ;; esac
  echo "$target/release/examples/$1"
}

# The arguments as absolute paths, a line each.
absolute() {
  local file
  for file in "$@"; do
    case $file in /*) echo "$file" ;; *) echo "$cd_from/$file" ;; esac
  done
}

command -v g++ >/dev/null || fail "no g++"
mkdir -p "$out"
