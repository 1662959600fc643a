#!/usr/bin/env bash
# Measures a device: limits, tuning, forward passes, renders, refinement and self-tests, then
# PyTorch and gsplat. Writes a JSON file per part, results.json with all parts, and tables.md.
# Failed or slow parts do not stop the rest.
# usage: tools/bench/report.sh OUT
#   PARTS     default "device peak tune forward render refine doctor pytorch gsplat"
#   MINUTES   budget, default 10: parts that have not begun by then are left out
#   PATIENCE  timeout of a part in seconds, default 120
#   WEIGHTS   default seeded:vitg     VIEWS  default "24 48 96 192"     SIZE  network input size
#   SCENES    Gaussians of renders, default 36000,102000,500000,2000000,6000000
#   RUNS      default "--warmup 1 --repeats 5"; the paper's are "--warmup 5 --repeats 20"
#   PYTHON    Python with PyTorch (and gsplat), timed in the same run
#   ZIPSPLAT  built program to run on the system's driver; default: set up and build
set -euo pipefail
out=${1:?usage: tools/bench/report.sh OUT}
here=$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")
if [[ -n ${ZIPSPLAT:-} ]]; then
  program=("$ZIPSPLAT")
  say() { echo "zipsplat: $*" >&2; }
else
  quiet=1
  # shellcheck source-path=SCRIPTDIR
  source "$here/../setup.sh"
  cargo build --manifest-path "$root/Cargo.toml" --release --quiet -p zipsplat-cli
  program=(cargo run --manifest-path "$root/Cargo.toml" --release --quiet -p zipsplat-cli --)
fi
read -ra runs <<< "${RUNS:---warmup 1 --repeats 5}"
read -ra views <<< "${VIEWS:-24 48 96 192}"
scenes=${SCENES:-36000,102000,500000,2000000,6000000}
parts=${PARTS:-device peak tune forward render refine doctor pytorch gsplat}
mkdir -p "$out"

# report NAME ARGS...: writes the command's result to NAME.json, its messages to NAME.log.
report() {
  local name=$out/$1
  [[ " $parts " == *" ${1%%-*} "* ]] || return 0
  rm -f "$name.json" "$name.log"
  if ((SECONDS > 60 * ${MINUTES:-10})); then
    echo "left out: the budget was spent" > "$name.log"
    return 0
  fi
  say "${*:2}"
  timeout "${PATIENCE:-120}" "${program[@]}" "${@:2}" --json > "$name.part" 2> "$name.log" || say "failed, see $name.log"
  if [[ -s $name.part ]]; then mv "$name.part" "$name.json"; else rm "$name.part"; fi
}

forward=(bench forward --weights "${WEIGHTS:-seeded:vitg}" ${SIZE:+--input-size "$SIZE"} "${runs[@]}")
render=(bench render --gaussians "$scenes" --size 252x252,1920x1080,3840x2160 --sh 1 "${runs[@]}")
SECONDS=0 # without set-up and build
report device doctor list
for _ in 1 2 3; do report peak bench peak; done # until the clock is at its highest
report tune doctor tune
for count in "${views[@]}"; do
  report "forward-$count" "${forward[@]}" --views "$count" --ratio 1,0.5,auto
done
report "forward-${views[-1]}-pool" "${forward[@]}" --views "${views[-1]}" --ratio auto --kv-pool 2,3
report "forward-${views[0]}-fp32" "${forward[@]}" --views "${views[0]}" --ratio 1 --precision fp32
report render "${render[@]}"
report refine bench refine --gaussians "${scenes%%,*},102000" "${runs[@]}"
report doctor doctor
if [[ -n ${PYTHON:-} ]]; then
  for count in "${views[@]}"; do
    report "pytorch-$count" "${forward[@]}" --views "$count" --ratio 1,auto --pytorch "$PYTHON"
  done
  if "$PYTHON" -c 'import gsplat' 2> /dev/null; then report gsplat "${render[@]}" --gsplat "$PYTHON"; fi
fi
python3 "$here/tables.py" "$out"
