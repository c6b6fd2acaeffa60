#!/bin/sh
# Builds the web page's WebAssembly, web/assets/page.wasm, from page/. Needed after changes of page/, viewing/ or stream/; the test
# `cargo test -p flyrig-page --test wasm` compares the file with the sources.
set -eu
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}/page"
# Paths of this computer do not belong into the file.
flags="--remap-path-prefix=$HOME=home --remap-path-prefix=$PWD=flyrig"
if rustc --print target-libdir --target wasm32-unknown-unknown 2>/dev/null | xargs test -d; then
    echo "building with the toolchain's wasm32-unknown-unknown"
    RUSTFLAGS="$flags" cargo build --locked --profile page --target wasm32-unknown-unknown -p flyrig-page --target-dir "$target"
elif command -v rustup >/dev/null && rustup target add wasm32-unknown-unknown; then
    RUSTFLAGS="$flags" cargo build --locked --profile page --target wasm32-unknown-unknown -p flyrig-page --target-dir "$target"
else
    echo "the target wasm32-unknown-unknown is missing; run: rustup target add wasm32-unknown-unknown" >&2
    exit 1
fi
cp "$target/wasm32-unknown-unknown/page/flyrig_page.wasm" web/assets/page.wasm
ls -l web/assets/page.wasm
