#!/usr/bin/env bash
# Trains briefly on a CPU. The loss must fall and the engine reconstruct with the weights, also from
# photos in the layouts of RealEstate10K and DL3DV and a Depth Anything 3 backbone.
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

shipped=$root/engine/models/nano.safetensors
"$python" "$root/tools/train/train.py" --config "$root/tools/train/pocket.json" --out "$out/grown" --steps 1 \
    --resume "$shipped" --zipsplat "$zipsplat" --set pool_gb=0.03 --set batch_views=4 --set reuse=1000 --set muon=false \
    --set size=126 --set learning_rate=0 --set architecture.gaussians_per_token=49 --set 'anchor_cells=[7,7]' \
    --set architecture.color_width=256 --set architecture.color_heads=4 --set architecture.color_hidden=256 \
    --set architecture.head_hidden=896
"$python" - "$shipped" "$out/grown/model.safetensors" <<'END'
import json, sys
from safetensors import safe_open
before, grown = (json.loads(safe_open(path, "np").metadata()["zipsplat.training"])["unseen_psnr"]["priors_r1"]
                 for path in sys.argv[1:])
assert abs(grown - before) < 1, f"found {grown} dB with more Gaussians, expected about {before}"
END

"$python" "$root/tests/train/captures.py" "$zipsplat" "$out/sets"
"$python" - "$out" "$root/tools/train" <<'END'
import json, sys
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
out, train = sys.argv[1:]
sys.path.insert(0, train)
from losses import Lpips
released = {"backbone.backbone.": "model.backbone.pretrained.", "backbone.cam_enc.": "model.cam_enc."}
save_file({theirs + name.removeprefix(ours): value for name, value in load_file(f"{out}/model.safetensors").items()
           for ours, theirs in released.items() if name.startswith(ours)}, f"{out}/release.safetensors")
save_file({name: torch.rand(shape) / 1000 for name, shape in Lpips.shapes().items()}, f"{out}/lpips.safetensors")
architecture = json.loads(safe_open(f"{out}/model.safetensors", "np").metadata()["zipsplat.architecture"])
small = {"size": 56, "views": [2, 2], "targets": 2, "record_views": 4, "gap": [6, 8], "evaluate": [2, 2], "batch_scenes": 4,
         "views_at_once": 2, "scenes": 17}
json.dump({"base": f"{train}/paper.json", "architecture": architecture, **small}, open(f"{out}/paper.json", "w"))
fusion = {name: architecture[name] for name in architecture if name.startswith(("color_", "fusion_", "width", "heads", "ffn_", "head_"))}
vggt = {**fusion, "depth": 8, "alt_start": 2, "qk_norm_start": 2, "rope_start": 2, "out_layers": [3, 5, 7]}
json.dump({"base": f"{train}/vggt.json", "architecture": vggt, **small}, open(f"{out}/vggt.json", "w"))
END
photos=(train.py --config "$out/paper.json" --out "$out/photos" --data "re10k:$out/sets/re10k" --data "dl3dv:$out/sets/dl3dv"
  --backbone "$out/release.safetensors" --lpips "$out/lpips.safetensors")
(cd "$root/tools/train" && CUDA_VISIBLE_DEVICES='' "$python" -m torch.distributed.run --standalone --nproc-per-node 2 "${photos[@]}" --steps 4)
(cd "$root/tools/train" && "$python" "${photos[@]}" --steps 6 --resume "$out/photos")
"$python" "$root/tools/train/train.py" --config "$out/vggt.json" --out "$out/vggt" --steps 2 --zipsplat "$zipsplat" --lpips "$out/lpips.safetensors"
"$python" "$root/tools/train/train.py" --config "$root/tools/train/da3s.json" --out "$out/da3s" --steps 2 --zipsplat "$zipsplat" \
    --lpips "$out/lpips.safetensors" --set size=56 --set batch_scenes=2 --set scenes=2 --set record_views=12 --set pool_gb=0.03
"$python" "$root/tools/train/ablate.py" --config "$root/tools/train/ablation.json" --out "$out/ablation" --only 0 --steps 2 \
    --zipsplat "$zipsplat" --backbone "$out/model.safetensors" --set scenes=4 | tee "$out/ablation.md"
grep -q '^| full | 1,024 | [0-9.]* | [0-9.]* | [0-9.]* |$' "$out/ablation.md"
"$zipsplat" info "$out/photos/model.safetensors"

"$python" "$root/tools/train/check.py" dump "$out/model.safetensors" "$out/golden.safetensors"
"$zipsplat" scene --seed 7 --views 4 --size 84x84 -o "$out/scene"
"$zipsplat" reconstruct "$out/scene/images" --weights "$out/model.safetensors" -o "$out/scene.ply"
test -s "$out/scene.ply"
"$zipsplat" reconstruct "$out/scene/images" --weights "$out/vggt/model.safetensors" -o "$out/vggt.ply"
test -s "$out/vggt.ply"
echo "smoke test of training: passed"
