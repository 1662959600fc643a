#!/usr/bin/env bash
# Trains briefly on a CPU and checks that the loss falls and the engine reconstructs with the
# weights, also from photos in the layouts of RealEstate10K and DL3DV and a Depth Anything 3
# backbone.
# usage: PYTHON=VENV/bin/python tests/train/smoke.sh target/release/zipsplat
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
zipsplat=$(realpath "$1")
python=${PYTHON:-python3}
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT

"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out" --steps 40 \
    --zipsplat "$zipsplat" --set pool_gb=0.03 --set batch_views=12 --set log_seconds=1 --set reuse=1000 \
    --set muon=false --set size=56 --set geometry_until=0 --set architecture.gaussians_per_token=16 --set 'anchor_cells=[4,4]' \
    --set architecture.color_width=64 --set architecture.color_heads=1 --set architecture.color_hidden=64 \
    --set architecture.head_hidden=512
"$python" - "$out/log.csv" <<'END'
import csv, sys
losses = [float(row["l1"]) for row in csv.DictReader(open(sys.argv[1])) if row["l1"]]
assert len(losses) >= 2 and losses[-1] < 0.8 * losses[0], f"found losses {losses}, expected them to fall by a fifth"
END

"$python" "$root/tests/train/growing.py" "$out/model.safetensors"

"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out/finer" --minutes 0.05 \
    --resume "$out/model.safetensors" --zipsplat "$zipsplat" --set pool_gb=0.03 --set batch_views=12 --set reuse=1000 \
    --set muon=false --set size=56 --set learning_rate=0
"$python" - "$out/model.safetensors" "$out/finer/model.safetensors" <<'END'
import json, sys
from safetensors import safe_open
coarse, fine = (json.loads(safe_open(path, "np").metadata()["zipsplat.training"])["unseen_psnr"]["priors_r1"]
                for path in sys.argv[1:])
assert fine > coarse - 2.5, f"found {fine} dB with more Gaussians, expected about {coarse}"
END

"$python" "$root/tests/train/captures.py" "$zipsplat" "$out/sets"
"$python" - "$out/model.safetensors" "$out/release.safetensors" <<'END'
import sys
from safetensors.torch import load_file, save_file
released = {"backbone.backbone.": "model.backbone.pretrained.", "backbone.cam_enc.": "model.cam_enc."}
save_file({theirs + name.removeprefix(ours): value for name, value in load_file(sys.argv[1]).items()
           for ours, theirs in released.items() if name.startswith(ours)}, sys.argv[2])
END
"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out/photos" --steps 4 \
    --data "re10k:$out/sets/re10k" --data "dl3dv:$out/sets/dl3dv" --backbone "$out/release.safetensors" \
    --set muon=false --set backbone_rate=0.1 --set record_views=4 --set 'gap=[6,8]' --set size=56 --set 'views=[2,2]' \
    --set 'evaluate=[2,2]' --set batch_views=4 --set scenes=17 --set geometry_until=0
"$zipsplat" info "$out/photos/model.safetensors"

"$python" "$root/tools/train/check.py" dump "$out/model.safetensors" "$out/golden.safetensors"
"$zipsplat" scene --seed 7 --views 4 --size 84x84 -o "$out/scene"
"$zipsplat" reconstruct "$out/scene/images" --weights "$out/model.safetensors" -o "$out/scene.ply"
test -s "$out/scene.ply"
echo "smoke test of training: passed"
