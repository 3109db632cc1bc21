#!/usr/bin/env bash
# Fuzzes the readers and writers of nuage-vdb, and the reader of packed files: ten million runs or twenty minutes per target, whichever comes first.
#
#   fuzz/run.sh [TARGET ...]        targets: read read_box round_trip metadata nanovdb nuage
#
# RUNS (10000000) and SECS (1200) change the bounds, CARGO_FUZZ names another cargo-fuzz. Needs a C++ compiler. A crash
# ends the run and leaves its input in fuzz/artifacts/TARGET.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"

runs=${RUNS:-10000000}
secs=${SECS:-1200}
targets=("$@")
if ((${#targets[@]} == 0)); then targets=(read read_box round_trip metadata nanovdb nuage); fi

fuzz=${CARGO_FUZZ:-cargo-fuzz}
if ! command -v "$fuzz" >/dev/null; then
    echo "fuzz/run.sh: cargo-fuzz is absent; running: cargo install cargo-fuzz" >&2
    cargo install --quiet --locked cargo-fuzz
fi

host=$(rustc -vV | sed -n 's/^host: //p')
cargo run --quiet --release --example seeds -- corpus
for target in "${targets[@]}"; do
    echo "== $target"
    # Without a sanitizer, so that a stable compiler will do: the crate holds no unsafe code.
    "$fuzz" run --sanitizer none --target "$host" "$target" -- -runs="$runs" -max_total_time="$secs" \
        -rss_limit_mb=2048 -timeout=10 -print_final_stats=1 -verbosity=0 2>&1 |
        grep -E 'stat::|ERROR|SUMMARY|panicked|Test unit|^Done|^INFO: Seed' || true
    if compgen -G "artifacts/$target/*" >/dev/null; then
        echo "fuzz/run.sh: $target left findings in fuzz/artifacts/$target" >&2
        exit 1
    fi
done
