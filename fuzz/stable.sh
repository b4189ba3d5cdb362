#!/bin/sh
# stable.sh TARGET SECONDS [libFuzzer's options]: runs a fuzz target with the stable compiler. Coverage is compiled into the program's own
# code and into the readers below, everything else is as in any build.
set -eu
target=$1
seconds=$2
shift 2
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "$here/corpus/$target" "$here/artifacts/$target"
host=$(rustc --version --verbose | sed -n 's/^host: //p')
CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$here/target} RUSTC_WRAPPER=$here/coverage.sh \
    cargo build --manifest-path "$here/Cargo.toml" --target "$host" --bin "$target"
exec "${CARGO_TARGET_DIR:-$here/target}/$host/debug/$target" -max_total_time="$seconds" -rss_limit_mb=2048 -timeout=25 -max_len=65536 \
    -artifact_prefix="$here/artifacts/$target/" "$@" "$here/corpus/$target"
