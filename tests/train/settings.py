"""Settings of tools/train: initialization, learned queries, rates, a pretrained backbone,
LPIPS.

python tests/train/settings.py GOLDEN_FOLDER
"""

import copy
import json
import os
import sys
import tempfile
from pathlib import Path

TRAIN = Path(__file__).resolve().parents[2] / "tools" / "train"
sys.path.insert(0, str(TRAIN))

import torch
from safetensors.torch import load_file, save_file

import backbone
import losses
from check import paper
from data import batch
from initialize import initialize
from model import ZipSplat
from optimizer import Optimizer
from schedule import Schedule, read_config, validate
from weights import seeded

GOLDENS = Path(sys.argv[1])
POCKET = json.loads((TRAIN / "pocket.json").read_text())


def small(per_token=4, queries=0):
    width, color = 64, max(3 * per_token, 32)
    a = paper("test", width, 3, 1, (1, 2), position_grid=5, camera_depth=1, camera_heads=1, color_width=color, color_heads=1,
              color_hidden=64, head_hidden=2 * (width + color), gaussians_per_token=per_token)  # fmt: skip
    return ZipSplat(a, queries)


def scenes(cells, count=2, views=4, side=42):
    """Returns a batch of random scenes: two context views, one target."""
    rows = {
        "intrinsics": torch.tensor([40.0, 40.0, side / 2, side / 2]).expand(count, views, 4),
        "poses": torch.eye(4)[:3].repeat(count, views, 1, 1),
        "colors": torch.randint(256, (count, views, side, side, 3), dtype=torch.uint8),
        "depths": 1 + torch.rand(count, views, side, side),
    }
    rows["poses"][:, :, 0, 3] = 0.1 * torch.arange(views)
    context, targets = torch.tensor([[0, 1]]).expand(count, -1), torch.tensor([[2]]).expand(count, -1)
    return batch(rows, context, targets, 64, cells, 14)


def refused(call, *words):
    try:
        call()
    except SystemExit as error:
        assert all(word in str(error) for word in words), f"found {error}, expected {words}"
        return
    raise AssertionError(f"found no error, expected one of {words}")


def gaussians_of_a_token_start_together_where_they_are_coupled():
    data, spreads = scenes((2, 2)), []
    for coupled in (True, False):
        torch.manual_seed(0)
        model = initialize(small(), (2, 2), coupled=coupled)
        with torch.no_grad():
            means = model(data.images)[0][..., :3].unflatten(1, (-1, 4))
        spreads.append((means - means.mean(2, keepdim=True)).norm(dim=-1).mean().item())
    assert spreads[0] < 0.1 * spreads[1], spreads


def opacity_and_place_are_where_the_settings_say():
    for opacity, depth in ((-1.5, 0.9), (0.0, 0.0)):
        model = initialize(small(), (2, 2), opacity=opacity, depth=depth)
        with torch.no_grad():
            packed = model(scenes((2, 2)).images)[0]
        found = packed[..., 10].median().logit().item(), packed[..., 2].median().item()
        assert abs(found[0] - opacity) < 0.3 and abs(found[1] - depth) < 0.3, (found, opacity, depth)


def each_number_of_gaussians_has_its_cells():
    for per_token, cells in ((8, (2, 4)), (16, (4, 4)), (32, (4, 8)), (64, (8, 8)), (8, (2, 2))):
        data, model = scenes(cells), initialize(small(per_token), cells, jitter=0.0)
        gaussians, tokens = model(data.images)
        given = torch.ones(2) > 0
        _, parts = losses.total(gaussians, tokens, None, given, data, POCKET["losses"])
        assert parts["color"] < 0.02 if 14 % cells[0] == 0 and 14 % cells[1] == 0 else parts["color"] < 0.2, (cells, parts)
        assert gaussians.shape[1] == 2 * 9 * per_token and all(part.isfinite() for part in parts.values())


def learned_queries_are_as_many_whatever_the_scene():
    model = initialize(small(queries=7), (2, 2))
    for views in (1, 3):
        gaussians, tokens = model(torch.rand(2, views, 3, 42, 42), ratio=0.5)
        assert gaussians.shape[:2] == (2, 7 * 4) and tokens is None
        assert (gaussians[0] - gaussians[1]).abs().max() > 1e-4, "another scene, the same Gaussians"
    loss = gaussians[..., :3].square().mean() + gaussians[..., 11:].square().mean()
    loss.backward()
    assert model.queries.grad.abs().max() > 0 and model.color_queries.grad.abs().max() > 0
    assert not any("queries" in name for name in small().state_dict())


def the_backbone_has_a_rate_of_its_own():
    moved = {}
    for rate in (0.0, 0.1, 1.0):
        torch.manual_seed(0)
        model = initialize(small(), (2, 2))
        before = copy.deepcopy(model.state_dict())
        optimizer = Optimizer(model, 0.05, 0, 1, rate)
        model(torch.rand(1, 2, 3, 42, 42), priors=(torch.eye(4).expand(1, 2, 4, 4), torch.full((1, 2, 4), 40.0)))[0].sum().backward()
        for p in model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        optimizer.step(1e-3, 1.0)
        change = {name: (p - before[name]).abs().max().item() for name, p in model.state_dict().items()}
        moved[rate] = [change[f"{name}.attn.qkv.weight" if "blocks" in name else name] for name in
                       ("backbone.backbone.blocks.1", "backbone.backbone.blocks.0", "gaussian_head.gaussian_head.1.weight")]  # fmt: skip
    assert moved[0.0][0] == moved[0.0][1] == 0 < moved[0.0][2] == moved[1.0][2], moved
    assert abs(moved[0.1][0] / moved[1.0][0] - 0.1) < 0.01, moved
    assert Optimizer(model, 0.05, 0, 1, muon=False).muon is None


def a_released_backbone_sees_what_its_own_network_sees():
    golden = load_file(GOLDENS / "da3_tiny.v2.safetensors")
    names = json.loads((GOLDENS / "da3_tiny.manifest.json").read_text())["params"]
    names = {name: shape for name, shape in names.items() if not name.startswith("model.gs_head")}
    tensors = {name: seeded("da3_tiny", name, tuple(shape)).float() for name, shape in names.items()}
    model = ZipSplat(paper("da3_tiny", 128, 6, 2, (2, 3, 4, 5)))
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/model.safetensors"
        save_file(tensors, path)
        backbone.take_over(model, path)
        images = (golden["in/images_u8"].double() / 255)[None]
        with torch.no_grad():
            features = model.double().backbone.backbone(images, None, {})
        for i, feature in enumerate(features):
            truth = golden[f"bb/feat{i}"].double()
            error = (torch.cat(feature, -1)[0] - truth).abs().max() / truth.square().mean().sqrt()
            # The release's last norm has another epsilon.
            assert error < 1e-4, (i, error)

        missing = {name: value for name, value in tensors.items() if "blocks.3.norm1.bias" not in name}
        save_file(missing, path)
        refused(lambda: backbone.take_over(model, path), path, "blocks.3.norm1.bias is missing")
        save_file(tensors, path)
        refused(lambda: backbone.take_over(small(), path), "another backbone", "expected [64]")
        save_file({"head.weight": torch.zeros(1)}, path)
        refused(lambda: backbone.take_over(model, path), "found no backbone")


def lpips_is_the_authors():
    golden = load_file(GOLDENS / "lpips.safetensors")
    home = Path(os.environ.get("ZIPSPLAT_CACHE") or Path.home() / ".cache" / "zipsplat") / "lpips_vgg.safetensors"
    if not home.is_file():
        print(f"{home}: not there (tools/lpips.py fetches it): LPIPS was not compared")
        return
    # In f32, rounding picks the maximum among equal features of black pixels, and so the gradient's
    # path.
    distance = losses.Lpips(home).double()
    for i in range(3):
        a, b = (golden[f"{i}/{name}"].double()[None] for name in "ab")
        a.requires_grad_()
        found = distance(a, b)
        found.backward()
        truth, d_a = golden[f"{i}/vgg/loss"].item(), golden[f"{i}/vgg/d_a"].double()
        assert abs(found.item() - truth) < 1e-5 * truth, (i, found.item(), truth)
        error = (a.grad[0] - d_a).square().mean().sqrt() / d_a.square().mean().sqrt()
        assert error < 1e-4, (i, error)


def contradictions_are_refused_by_name():
    def changed(**changes):
        config = copy.deepcopy(POCKET)
        for name, value in changes.items():
            section = config
            *parents, last = name.split("__")
            for parent in parents:
                section = section[parent]
            section[last] = value
        return lambda: validate(config)

    changed()()
    refused(changed(anchor_cells=[5, 5]), "anchor_cells", "[5, 5]", "36")
    refused(changed(architecture__color_width=64), "architecture.color_width", "64", "108")
    refused(changed(architecture__head_hidden=600), "architecture.head_hidden", "600", "640")
    refused(changed(backbone_rate=2), "backbone_rate", "2")
    refused(changed(gap=[9, 3]), "gap", "[9, 3]")
    refused(changed(muon="adam"), "muon", "adam")
    refused(changed(queries=-1), "queries", "-1")
    refused(changed(initial__coupled=1), "initial.coupled")
    refused(changed(queries=64), "losses.anchor", "learned queries")
    free = dict(queries=64, losses__anchor=0, losses__ray=0, losses__color=0)
    refused(changed(**free), "geometry_until")
    changed(**free, geometry_until=0, geometry_after=0)()
    refused(lambda: read_config(TRAIN / "pocket.json", ["quaries=3"]), "quaries")


def a_schedule_follows_the_share_that_is_done():
    schedule = Schedule(POCKET)
    assert schedule.rate(0) == 0 and schedule.rate(1) < 1e-9 and schedule.rate(0.03) == POCKET["learning_rate"]
    assert schedule.weights(0)["anchor"] == 1 and schedule.weights(0.6)["anchor"] == 0


TESTS = (
    gaussians_of_a_token_start_together_where_they_are_coupled,
    opacity_and_place_are_where_the_settings_say,
    each_number_of_gaussians_has_its_cells,
    learned_queries_are_as_many_whatever_the_scene,
    the_backbone_has_a_rate_of_its_own,
    a_released_backbone_sees_what_its_own_network_sees,
    lpips_is_the_authors,
    contradictions_are_refused_by_name,
    a_schedule_follows_the_share_that_is_done,
)

if __name__ == "__main__":
    torch.set_num_threads(1)
    for test in TESTS:
        torch.manual_seed(0)
        test()
        print(f"{test.__name__}: passed")
