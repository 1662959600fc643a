#!/usr/bin/env bash
# Compares seconds of `zipsplat reconstruct --each` and of a loop of `zipsplat reconstruct` over equal captures.
# usage: tools/bench/batch.sh [CAPTURES] [PHOTOS] [OPTIONS of both]      default 12 of 4 photos
#   ZIPSPLAT  the command; default the checkout's
set -euo pipefail
zipsplat=${ZIPSPLAT:-$(dirname "${BASH_SOURCE[0]}")/../zipsplat}
captures=${1:-12} photos=${2:-4}
shift $(($# < 2 ? $# : 2))
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT
for ((i = 0; i < captures; ++i)); do
  "$zipsplat" scene --seed "$i" --views "$photos" --size 640x480 -o "$work/places/$i" &> /dev/null
  mv "$work/places/$i/images" "$work/images" && rm -r "$work/places/$i" && mv "$work/images" "$work/places/$i"
done
loop() {
  local place
  for place in "$work"/places/*; do "$zipsplat" reconstruct "$place" -o "$work/loop-${place##*/}.ply" "$@" 2> /dev/null; done
}
each() { "$zipsplat" reconstruct --each "$work/places" -o "$work/batch" "$@" 2> /dev/null; }
TIMEFORMAT=%R
for turn in 1 2; do
  echo "turn $turn, $captures captures of $photos photos: loop $({ time loop "$@" > /dev/null; } 2>&1) s," \
    "--each $({ time each "$@" > /dev/null; } 2>&1) s"
  for place in "$work"/places/*; do cmp "$work/loop-${place##*/}.ply" "$work/batch/${place##*/}.ply"; done
  rm -r "$work/batch"
done
