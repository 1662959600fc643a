#!/usr/bin/env bash
# A minute of training on a CPU: the loss falls, and the engine reconstructs a scene with the weights.
# usage: PYTHON=VENV/bin/python tests/train/smoke.sh target/release/zipsplat
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
zipsplat=$(realpath "$1")
python=${PYTHON:-python3}
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out" --minutes 1 \
    --zipsplat "$zipsplat" --set pool_gb=0.03 --set batch_views=12 --set log_seconds=1 --set reuse=1000 \
    --set geometry_until=0 --set architecture.gaussians_per_token=16 --set 'anchor_cells=[4,4]' \
    --set architecture.color_width=64 --set architecture.color_heads=1 --set architecture.color_hidden=64 \
    --set architecture.head_hidden=512
"$python" - "$out/log.csv" <<'END'
import csv, sys
losses = [float(row["l1"]) for row in csv.DictReader(open(sys.argv[1])) if row["l1"]]
assert len(losses) >= 2 and losses[-1] < 0.8 * losses[0], f"found losses {losses}, expected them to fall by a fifth"
END

"$python" "$root/tests/train/growing.py" "$out/model.safetensors"

# With more Gaussians a token and wider colours, untrained, it shows nearly the same.
"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out/finer" --minutes 0.05 \
    --resume "$out/model.safetensors" --zipsplat "$zipsplat" --set pool_gb=0.03 --set batch_views=12 --set reuse=1000 \
    --set learning_rate=0
"$python" - "$out/model.safetensors" "$out/finer/model.safetensors" <<'END'
import json, sys
from safetensors import safe_open
coarse, fine = (json.loads(safe_open(path, "np").metadata()["zipsplat.training"])["unseen_psnr"]["priors_r1"]
                for path in sys.argv[1:])
assert fine > coarse - 1.5, f"found {fine} dB with more Gaussians, expected about {coarse}"
END

"$python" "$root/tools/train/check.py" dump "$out/model.safetensors" "$out/golden.safetensors"
"$zipsplat" scene --seed 7 --views 4 --size 84x84 -o "$out/scene"
"$zipsplat" reconstruct "$out/scene/images" --weights "$out/model.safetensors" -o "$out/scene.ply"
test -s "$out/scene.ply"
echo "smoke test of training: passed"
