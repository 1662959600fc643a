#!/usr/bin/env bash
# Photos of one place to a 3D scene and pictures of it: out/scene.ply, out/NNN.png, out/contact.png.
# usage: tools/demo.sh [PHOTO...]      ZIPSPLAT_WEIGHTS: a checkpoint, default seeded:vits
set -euo pipefail
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

photos=("$@")
[[ $# != 0 ]] || photos=("$root"/tests/data/photos/*.jpg)
weights=${ZIPSPLAT_WEIGHTS:-seeded:vits}
out=$root/out
mkdir -p "$out"
rm -f "$out"/[0-9][0-9][0-9].png

zipsplat() { cargo run --manifest-path "$root/Cargo.toml" --release --quiet -p zipsplat-cli -- "$@"; }

stage build cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-cli
stage reconstruct zipsplat reconstruct "${photos[@]}" --weights "$weights" -o "$out/scene.ply"
stage render zipsplat render "$out/scene.ply" --wiggle --frames 8 -o "$out"
say "the scene is $out/scene.ply, its pictures $out/000.png and on, all of them together $out/contact.png"
[[ $weights != seeded:* ]] ||
  say "the weights $weights are random numbers, so the pictures show noise and NOT a reconstruction of the photos"
