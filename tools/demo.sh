#!/usr/bin/env bash
# Estimates cameras of photos with COLMAP, reconstructs, refines, and renders a camera path
# (out/photos/contact.png). Without arguments uses the banana photos, then compares renders of a
# procedural scene with held-out photos (out/place/comparison.png).
# usage: tools/demo.sh [PHOTO|FOLDER|VIDEO...]      ZIPSPLAT_WEIGHTS: default the built-in model
set -euo pipefail
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

out=$root/out
seed=2199023255552 # 2^41, unused in training
views=24 side=480
weights=(${ZIPSPLAT_WEIGHTS:+--weights "$ZIPSPLAT_WEIGHTS"})
mkdir -p "$out/photos"

stage build cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-cli
# zipsplat reports COLMAP as missing.
command -v colmap > /dev/null || python3 -c 'import pycolmap' 2> /dev/null || apt_install colmap || true
photos=("${@:-$root/tests/data/bananas}")
stage 'cameras, scene and refinement' zipsplat reconstruct "${photos[@]}" --views $views --cameras colmap \
  --cameras-out "$out/photos/transforms.json" --refine=150 --max-image-size ${side}x$side ${weights[@]+"${weights[@]}"} \
  --overwrite -o "$out/photos/scene.ply"
stage render zipsplat render "$out/photos/scene.ply" --spline "$out/photos/transforms.json" --frames 12 \
  --overwrite -o "$out/photos"
stage page zipsplat view "$out/photos/scene.ply" --cameras "$out/photos/transforms.json" --overwrite -o "$out/photos/scene.html"
say "renders along the photos' cameras: $out/photos/contact.png; viewer: $out/photos/scene.html; scene: $out/photos/scene.ply"
if [[ $# == 0 ]]; then
  stage 'procedural photos' zipsplat scene --seed $seed --views 16 -o "$out/place"
  stage 'reconstruct and refine' zipsplat eval "$out/place" --views 8 --refine 100 --init scene ${weights[@]+"${weights[@]}"} -o "$out/place"
  stage render zipsplat render "$out/place/scene.ply" --wiggle --frames 8 --overwrite -o "$out/place"
  say "held-out photos, their renders, and the nearest input photos: $out/place/comparison.png"
fi
[[ ${ZIPSPLAT_WEIGHTS:-} != seeded:* ]] ||
  say "the weights $ZIPSPLAT_WEIGHTS are random numbers, so these pictures show noise and NOT a reconstruction of the photos"
