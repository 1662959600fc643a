#!/usr/bin/env bash
# Photos alone become a scene that can be shown: COLMAP finds their cameras (on Debian it is installed where it is missing), the scene
# is reconstructed, refined against the photos, and flown through: out/photos/contact.png. Without arguments the photos are those
# of a bunch of bananas, which come with the project, and a procedural place is shown, too, that the model has never seen,
# reconstructed from 8 photos and compared with others: out/place/comparison.png.
# usage: tools/demo.sh [PHOTO|FOLDER|VIDEO...]      ZIPSPLAT_WEIGHTS: a checkpoint, default the embedded model
set -euo pipefail
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

out=$root/out
seed=2199023255552 # 2^41: training counts from 0
views=24 side=640
weights=(${ZIPSPLAT_WEIGHTS:+--weights "$ZIPSPLAT_WEIGHTS"})
mkdir -p "$out/photos"

# picture_size CAMERAS: that of their first photo, scaled so that the longer side is no more than $side.
picture_size() {
  awk -F '[:,]' -v side="$side" '
    /"w":/ && !w { w = $2 + 0 }
    /"h":/ && !h { h = $2 + 0 }
    END { s = side / (w > h ? w : h); if (s > 1) s = 1; printf "%dx%d\n", w * s, h * s }' "$1"
}

stage build cargo build --manifest-path "$root/Cargo.toml" --release -p zipsplat-cli
command -v colmap > /dev/null || python3 -c 'import pycolmap' 2> /dev/null || apt_install colmap || true # zipsplat says what is missing
photos=("${@:-$root/tests/data/bananas}")
stage 'cameras, scene and refinement' zipsplat reconstruct "${photos[@]}" --views $views --poses find \
  --cameras-out "$out/photos/transforms.json" --refine=200 --refine-size ${side}x$side ${weights[@]+"${weights[@]}"} \
  --overwrite -o "$out/photos/scene.ply"
stage render zipsplat render "$out/photos/scene.ply" --spline "$out/photos/transforms.json" --frames 12 \
  --size "$(picture_size "$out/photos/transforms.json")" --overwrite -o "$out/photos"
stage page zipsplat view "$out/photos/scene.ply" --poses "$out/photos/transforms.json" --overwrite -o "$out/photos/scene.html"
say "a flight through the photos' cameras: $out/photos/contact.png; a page to look around in: $out/photos/scene.html; the scene: $out/photos/scene.ply"
if [[ $# == 0 ]]; then
  stage 'photos of a place' zipsplat scene --seed $seed --views 16 -o "$out/place"
  stage 'reconstruct and refine' zipsplat eval "$out/place" --views 8 --refine 100 --start scene ${weights[@]+"${weights[@]}"} -o "$out/place"
  stage render zipsplat render "$out/place/scene.ply" --wiggle --frames 8 --overwrite -o "$out/place"
  say "photos that it was not shown, what it drew in their place, and the nearest it was shown: $out/place/comparison.png"
fi
[[ ${ZIPSPLAT_WEIGHTS:-} != seeded:* ]] ||
  say "the weights $ZIPSPLAT_WEIGHTS are random numbers, so these pictures show noise and NOT a reconstruction of the photos"
