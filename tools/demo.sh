#!/usr/bin/env bash
# A procedural place that the model has never seen, reconstructed from 8 of its photos, refined against them, and compared with the others:
# out/place/comparison.png, and a flight around it: out/place/contact.png. Photos given are reconstructed as well:
# out/scene.ply, out/NNN.png, out/contact.png.
# usage: tools/demo.sh [PHOTO...]      ZIPSPLAT_WEIGHTS: a checkpoint, default the embedded model
set -euo pipefail
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

out=$root/out
seed=2199023255552 # 2^41: training counts from 0
weights=(${ZIPSPLAT_WEIGHTS:+--weights "$ZIPSPLAT_WEIGHTS"})
mkdir -p "$out"

stage build cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-cli
stage 'photos of a place' zipsplat scene --seed $seed --views 16 -o "$out/place"
stage 'reconstruct and refine' zipsplat eval "$out/place" --views 8 --refine 100 --start scene ${weights[@]+"${weights[@]}"} -o "$out/place"
stage render zipsplat render "$out/place/scene.ply" --wiggle --frames 8 --overwrite -o "$out/place"
say "photos that it was not shown, what it drew in their place, and the nearest it was shown: $out/place/comparison.png"
if [[ $# != 0 ]]; then
  stage 'reconstruct your photos' zipsplat reconstruct "$@" ${weights[@]+"${weights[@]}"} -o "$out/scene.ply"
  stage render zipsplat render "$out/scene.ply" --wiggle --frames 8 --overwrite -o "$out"
  say "your photos are $out/scene.ply, pictures of it $out/000.png and on, all of them together $out/contact.png"
fi
[[ ${ZIPSPLAT_WEIGHTS:-} != seeded:* ]] ||
  say "the weights $ZIPSPLAT_WEIGHTS are random numbers, so these pictures show noise and NOT a reconstruction of the photos"
