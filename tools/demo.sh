#!/usr/bin/env bash
# Photos of one place to a 3D scene and pictures of it: out/scene.ply, out/NNN.png, out/contact.png. Without photos it makes
# a procedural place first, and also draws that from its exact depth: out/place/.
# usage: tools/demo.sh [PHOTO...]      ZIPSPLAT_WEIGHTS: a checkpoint, default seeded:vits
set -euo pipefail
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

weights=${ZIPSPLAT_WEIGHTS:-seeded:vits}
out=$root/out
mkdir -p "$out"
rm -f "$out"/[0-9][0-9][0-9].png

zipsplat() { cargo run --manifest-path "$root/Cargo.toml" --release --quiet -p zipsplat-cli -- "$@"; }

stage build cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-cli
photos=("$@")
if [[ $# == 0 ]]; then
  stage place zipsplat scene --seed 11 --views 8 --splats -o "$out/place"
  stage 'drawing the place' zipsplat render "$out/place/splats.ply" --wiggle --frames 8 -o "$out/place"
  say "the place's photos are $out/place/images, drawn from its exact depth it is $out/place/contact.png"
  photos=("$out/place/images")
fi
stage reconstruct zipsplat reconstruct "${photos[@]}" --weights "$weights" -o "$out/scene.ply"
stage render zipsplat render "$out/scene.ply" --wiggle --frames 8 -o "$out"
say "the scene is $out/scene.ply, its pictures $out/000.png and on, all of them together $out/contact.png"
[[ $weights != seeded:* ]] ||
  say "the weights $weights are random numbers, so these pictures show noise and NOT a reconstruction of the photos"
