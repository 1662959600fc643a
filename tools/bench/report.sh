#!/usr/bin/env bash
# Writes a GPU's limits, doctor, tuning, rates, renders and forward times to text files, and other
# implementations' times last. A failed part does not stop the rest.
# usage: tools/bench/report.sh OUT      minutes on a large GPU
#   WEIGHTS   default seeded:vitg     VIEWS  default "24 48 96 192"
#   RUNS      default "--warmup 1 --repeats 5"; the paper's are "--warmup 5 --repeats 20"
#   PATIENCE  timeout of a part in seconds, default 300
#   PYTHON    Python with PyTorch (and gsplat), timed in the same run
#   ZIPSPLAT  built program to run on the system's driver; default: set up and build
set -euo pipefail
out=${1:?usage: tools/bench/report.sh OUT}
mkdir -p "$out"
if [[ -n ${ZIPSPLAT:-} ]]; then
  program=("$ZIPSPLAT")
  say() { echo "zipsplat: $*" >&2; }
else
  quiet=1
  # shellcheck source-path=SCRIPTDIR
  source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../setup.sh"
  program=(cargo run --manifest-path "$root/Cargo.toml" --release --quiet -p zipsplat-cli --)
fi
read -ra runs <<< "${RUNS:---warmup 1 --repeats 5}"
read -ra views <<< "${VIEWS:-24 48 96 192}"

# report NAME ARGS...: appends the command's output to NAME.txt.
report() {
  say "${*:2}"
  timeout "${PATIENCE:-300}" "${program[@]}" "${@:2}" >> "$out/$1.txt" 2>&1 || say "failed, see $out/$1.txt"
}

forward=(bench forward --weights "${WEIGHTS:-seeded:vitg}" "${runs[@]}")
scenes=(bench render --gaussians 36000,102000,500000,2000000,6000000 --size 252x252,1920x1080,3840x2160 --sh 1 "${runs[@]}")
report device doctor list
report device bench peak
report doctor doctor
report tune doctor tune
report render "${scenes[@]}"
for count in "${views[@]}"; do report forward "${forward[@]}" --views "$count" --ratio 1,0.5,auto; done
[[ -n ${PYTHON:-} ]] || exit 0
if "$PYTHON" -c 'import gsplat' 2> /dev/null; then report gsplat "${scenes[@]}" "--gsplat=$PYTHON"; fi
for count in "${views[@]}"; do report pytorch "${forward[@]}" --views "$count" --ratio 1,auto --pytorch "$PYTHON"; done
