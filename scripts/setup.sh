#!/usr/bin/env bash
# Installs what flyrig needs and this machine lacks; says what and why. Safe to run again: it then does nothing.
# Usage: scripts/setup.sh [--check] [chromium] [codespell]   (--check only reports, and fails when something is missing; chromium is for
# test-browser, codespell for check)
set -euo pipefail

check_only=false
[ "${1:-}" = "--check" ] && check_only=true

# package: why
wanted=(
  "build-essential:C and C++ compilers and make, for crates that build native code"
  "pkg-config:finds installed libraries for the build"
  "clang:the v4l crate reads the headers of the kernel with it"
  "libclang-dev:the same"
  "cmake:builds libjpeg-turbo, which compresses images"
  "nasm:the same"
  "libavformat-dev:video files"
  "libswscale-dev:the same"
  "libvulkan1:the Vulkan loader, to reach the graphics adapter"
)
# The software adapter is only needed where no other Vulkan driver is installed.
if ! ls /usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json >/dev/null 2>&1; then
  wanted+=("mesa-vulkan-drivers:Mesa's Vulkan drivers, with a software one for machines without a GPU")
fi
# Recorded motion for the simulated people.
wanted+=("assimp-testmodels:holds a captured walk (CMU 01_01.bvh) for the simulated people")

case " $* " in
  *" codespell "*) wanted+=("codespell:finds spelling mistakes in source and documents") ;;
esac
case " $* " in
  *" chromium "*) wanted+=("chromium:a browser, for the test of the web page") ;;
esac

say() { printf 'setup: %s\n' "$*"; }

missing=()
if command -v dpkg-query >/dev/null; then
  for entry in "${wanted[@]}"; do
    package=${entry%%:*}
    if ! dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed'; then
      missing+=("$package")
      say "missing $package (${entry#*:})"
    fi
  done
else
  say "this is not a Debian-like system: install the equivalents of these by hand, then build with cargo:"
  for entry in "${wanted[@]}"; do say "  ${entry%%:*} (${entry#*:})"; done
fi

if [ ${#missing[@]} -gt 0 ]; then
  if $check_only; then say "run 'make setup' to install them"; exit 1; fi
  as_root=()
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || { say "not root and no sudo: run 'apt-get install ${missing[*]}' as root, then try again"; exit 1; }
    as_root=(sudo)
  fi
  say "installing with apt-get: ${missing[*]}"
  "${as_root[@]}" apt-get update -qq
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
  say "installed"
fi

if ! command -v cargo >/dev/null; then
  say "Rust is missing: install rustup from https://rustup.rs (Debian 13 and later: apt-get install rustup), then try again."
  say "rust-toolchain.toml makes rustup fetch the right version by itself."
  exit 1
fi
