#!/usr/bin/env bash
# Everything that this project wants to know of a GPU, into text files: limits, hard cases, tiles, rates, pictures, the forward
# pass, and last what other implementations need for the same on that GPU. A part that fails or takes too long costs no other.
# usage: tools/bench/report.sh OUT      the numbers of this folder's README; takes minutes on a large GPU
#   WEIGHTS   default seeded:vitg     VIEWS  default "24 48 96 192"
#   RUNS      default "--warmup 1 --repeats 5"; the paper's are "--warmup 5 --repeats 20"
#   PATIENCE  seconds that a part may take, default 300
#   PYTHON    a Python with PyTorch (and gsplat): its times on the same device in the same run
#   ZIPSPLAT  a built program to run as it is, with the Vulkan driver that is there; else it is set up and built
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

# report NAME ARGS...: adds what the command says to NAME.txt.
report() {
  say "${*:2}"
  timeout "${PATIENCE:-300}" "${program[@]}" "${@:2}" >> "$out/$1.txt" 2>&1 || say "failed, see $out/$1.txt"
}

forward=(bench forward --weights "${WEIGHTS:-seeded:vitg}" "${runs[@]}")
scenes=(bench render --gaussians 36000,102000,500000,2000000,6000000 --size 252x252,1920x1080,3840x2160 --sh 1 "${runs[@]}")
report device info
report device bench peak
report doctor doctor
report tune tune
report gemm bench gemm
report render "${scenes[@]}"
for count in "${views[@]}"; do report forward "${forward[@]}" --views "$count" --ratio 1,0.5,auto; done
[[ -n ${PYTHON:-} ]] || exit 0
if "$PYTHON" -c 'import gsplat' 2> /dev/null; then report gsplat "${scenes[@]}" "--gsplat=$PYTHON"; fi
for count in "${views[@]}"; do report pytorch "${forward[@]}" --views "$count" --ratio 1,auto --pytorch "$PYTHON"; done
