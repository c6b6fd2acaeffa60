#!/bin/sh
# Builds the web page's WebAssembly, viewer/web/assets/page.wasm, from page/. Needed after changes of page/, viewing/ or stream/; the test
# `cargo test -p flyrig-page --test wasm` compares the file with the sources.
set -eu
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}/page"
# Paths of this computer do not belong into the file.
flags="--remap-path-prefix=$HOME=home --remap-path-prefix=$PWD=flyrig"
libraries="$(rustc --print target-libdir --target wasm32-unknown-unknown)"
if ! test -d "$libraries" && ! rustup target add wasm32-unknown-unknown; then
    echo "the target wasm32-unknown-unknown is missing; run: rustup target add wasm32-unknown-unknown" >&2
    exit 1
fi
RUSTFLAGS="$flags" cargo build --locked --profile page --target wasm32-unknown-unknown -p flyrig-page --target-dir "$target"
cp "$target/wasm32-unknown-unknown/page/flyrig_page.wasm" viewer/web/assets/page.wasm
ls -l viewer/web/assets/page.wasm
