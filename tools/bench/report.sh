#!/usr/bin/env bash
# Everything that this project wants to know of a GPU, into text files: limits, hard cases, tiles, rates, the forward pass, pictures.
# usage: tools/bench/report.sh OUT      the numbers for README.md's "Speed"; takes minutes on a large GPU
#   WEIGHTS  default seeded:vitg     VIEWS  default 24,48,96,192
#   PYTHON   a Python with PyTorch (and gsplat): its times on the same device in the same run
set -euo pipefail
out=${1:?usage: tools/bench/report.sh OUT}
mkdir -p "$out"
quiet=1
# shellcheck source-path=SCRIPTDIR
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../setup.sh"

# report NAME ARGS...: what the command says; a part that fails does not cost the others.
report() {
  say "$1"
  zipsplat "${@:2}" > "$out/$1.txt" 2>&1 || say "failed, see $out/$1.txt"
}

report info info
report doctor doctor
report tune tune
report peak bench peak
report forward bench forward --weights "${WEIGHTS:-seeded:vitg}" --views "${VIEWS:-24,48,96,192}" --ratio 1,0.5,auto \
  ${PYTHON:+--pytorch "$PYTHON"}
report render bench render --gaussians 36000,102000,500000,2000000,6000000 --size 252x252,1920x1080,3840x2160 --sh 1 \
  ${PYTHON:+"--gsplat=$PYTHON"}
