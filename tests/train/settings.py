"""Settings of tools/train: the paper's presets, initialization, losses, learned queries, rates, a
pretrained backbone, LPIPS.

python tests/train/settings.py GOLDEN_FOLDER
"""

import copy
import json
import math
import os
import random
import sys
import tempfile
from pathlib import Path

TRAIN = Path(__file__).resolve().parents[2] / "tools" / "train"
sys.path.insert(0, str(TRAIN))

import torch
from safetensors.torch import load_file, save_file

import backbone
import losses
import paper
import rasterize
from check import paper as architecture
from check import vggt_architecture
from initialize import initialize
from model import ZipSplat
from optimizer import Optimizer
from schedule import Schedule, read_config, validate
from steps import scenes
from weights import Architecture, seeded

GOLDENS = Path(sys.argv[1])
POCKET, PAPER = (read_config(TRAIN / f"{name}.json") for name in ("pocket", "paper"))


def small(per_token=4, queries=0):
    width, color = 64, max(3 * per_token, 32)
    a = architecture("test", width, 3, 1, (1, 2), position_grid=5, camera_depth=1, camera_heads=1, color_width=color, color_heads=1,
              color_hidden=64, head_hidden=2 * (width + color), gaussians_per_token=per_token)  # fmt: skip
    return ZipSplat(a, queries)


def refused(call, *words):
    try:
        call()
    except SystemExit as error:
        assert all(word in str(error) for word in words), f"found {error}, expected {words}"
        return
    raise AssertionError(f"found no error, expected one of {words}")


def gaussians_of_a_token_start_together_where_they_are_coupled():
    data, spreads = scenes(2, cells=(2, 2)), []
    for coupled in (True, False):
        torch.manual_seed(0)
        model = initialize(small(), (2, 2), coupled=coupled)
        with torch.no_grad():
            means = model(data.images)[0][..., :3].unflatten(1, (-1, 4))
        spreads.append((means - means.mean(2, keepdim=True)).norm(dim=-1).mean().item())
    assert spreads[0] < 0.1 * spreads[1], spreads
    model = initialize(small(), (1, 1), **PAPER["initial"])
    groups = model(data.images)[0].unflatten(1, (-1, 4))
    assert (groups == groups[:, :, :1]).all(), "expected identical Gaussians in a token"
    assert (groups[:, 0] - groups[:, 1]).abs().max() > 0


def opacity_and_place_are_where_the_settings_say():
    for opacity, depth in ((-1.5, 0.9), (0.0, 0.0)):
        model = initialize(small(), (2, 2), opacity=opacity, depth=depth)
        with torch.no_grad():
            packed = model(scenes(2).images)[0]
        found = packed[..., 10].median().logit().item(), packed[..., 2].median().item()
        assert abs(found[0] - opacity) < 0.3 and abs(found[1] - depth) < 0.3, (found, opacity, depth)


def each_number_of_gaussians_has_its_cells():
    for per_token, cells in ((8, (2, 4)), (16, (4, 4)), (32, (4, 8)), (64, (8, 8)), (8, (2, 2))):
        data, model = scenes(2, cells=cells), initialize(small(per_token), cells, jitter=0.0)
        gaussians, tokens = model(data.images)
        given = torch.ones(2) > 0
        _, parts = losses.total(gaussians, tokens, None, given, data, POCKET["losses"], POCKET)
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


def backbone_and_camera_encoder_have_rates_of_their_own():
    layers = ("backbone.backbone.blocks.1.attn.qkv", "backbone.backbone.blocks.0.attn.qkv", "backbone.cam_enc.trunk.0.attn.qkv",
              "gaussian_head.gaussian_head.1")  # fmt: skip
    moved, norms = {}, []
    for rates in ((0, 1), (0.1, 0.1), (1, 1)):
        torch.manual_seed(0)
        model = initialize(small(), (2, 2))
        before = copy.deepcopy(model.state_dict())
        optimizer = Optimizer(model, {**POCKET, "backbone_rate": rates[0], "camera_rate": rates[1]})
        model(torch.rand(1, 2, 3, 42, 42), priors=(torch.eye(4).expand(1, 2, 4, 4), torch.full((1, 2, 4), 40.0)))[0].sum().backward()
        for p in model.parameters():
            p.grad = torch.zeros_like(p) if p.grad is None else p.grad
        norms.append(optimizer.step(1e-3, 1.0))
        after = model.state_dict()
        moved[rates] = [(after[f"{name}.weight"] - before[f"{name}.weight"]).abs().max().item() for name in layers]
    frozen, slow, whole = moved.values()
    assert frozen[:2] == [0, 0] and min(frozen[2:] + whole) > 0 and slow[3] == whole[3], moved
    assert all(abs(slow[i] / whole[i] - 0.1) < 0.01 for i in range(3)), moved
    assert norms[0] < norms[1] == norms[2], norms
    assert Optimizer(model, PAPER).muon is None


def presets_have_the_published_settings():
    for name, published in (("paper", paper.PAPER), ("da3s", paper.ABLATIONS)):
        config = read_config(TRAIN / f"{name}.json")
        assert not (found := paper.differences(config, published)), f"{name}.json: found (ours, published) {found}"
        config["losses"]["depth"] = 0.02
        assert paper.differences(config, published) == {"losses.depth": (0.02, 0.01)}
        assert "! losses.depth" in paper.comparison(config) and "1 of " in paper.comparison(config)


def geometric_losses_are_as_written():
    means, points, free = torch.randn(2, 30, 3), torch.randn(2, 7, 3), torch.rand(2, 30) < 0.5
    nearest = torch.cdist(means, points).min(2).values
    pairs, losses.PAIRS = losses.PAIRS, 64  # several parts
    found = losses.chamfer(means, points, free)
    losses.PAIRS = pairs
    assert abs(found - (nearest.square() * free).mean()) < 1e-5, found
    alpha, truth, rendered = torch.rand(2, 1, 5, 5), torch.rand(2, 1, 5, 5) - 0.3, torch.rand(2, 1, 5, 5)
    pictures = rasterize.Pictures(None, alpha, alpha * rendered, None)
    found, expected = losses.depth(pictures, truth), (alpha * rendered - truth).abs()[truth > 0].mean()
    assert abs(found - expected) < 1e-6, (found, expected)


def a_released_backbone_sees_what_its_own_network_sees():
    golden = load_file(GOLDENS / "da3_tiny.v2.safetensors")
    names = json.loads((GOLDENS / "da3_tiny.manifest.json").read_text())["params"]
    names = {name: shape for name, shape in names.items() if not name.startswith("model.gs_head")}
    tensors = {name: seeded("da3_tiny", name, tuple(shape)).float() for name, shape in names.items()}
    model = ZipSplat(architecture("da3_tiny", 128, 6, 2, (2, 3, 4, 5)))
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


def vggt_starts_from_its_release_and_learns():
    """The golden weights have the released layout."""
    path = GOLDENS / "vggt_micro.weights.safetensors"
    model = initialize(ZipSplat(vggt_architecture("vggt_micro")), (1, 1), colors=False)
    backbone.take_over(model, path)
    golden = load_file(GOLDENS / "vggt_micro.v3.safetensors")
    images = (golden["in/images_u8"].double() / 255)[None]
    with torch.no_grad():
        features = model.double().backbone(images, None, None, {})
    for j, feature in ((0, features[0]), (1, features[1]), (3, features[2])):
        truth = golden[f"agg/feat{j}"][:, 5:].double()
        error = (torch.cat(feature, -1)[0] - truth).abs().max() / truth.square().mean().sqrt()
        assert error < 1e-5, (j, error)
    model.float()(torch.rand(1, 2, 3, 42, 42))[0].square().mean().backward()
    still = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not still, f"found no gradient of {still}"
    refused(lambda: backbone.take_over(small(), path), "backbone.aggregator.camera_token is unexpected")
    refused(lambda: read_config(TRAIN / "vggt.json", ["priors=0.2"]), "priors", "0.2", "VGGT")
    with torch.device("meta"):
        large = ZipSplat(Architecture.from_json(json.dumps(read_config(TRAIN / "vggt.json")["architecture"])))
    released = {}
    for name, shape in json.loads((GOLDENS / "vggt_1b.keys.json").read_text())["params"].items():
        count, shape = shape if "{}" in name else (1, shape)
        released |= {name.replace("{}", str(i)): shape for i in range(count) if name.startswith("aggregator.")}
    del released["aggregator.patch_embed.mask_token"]
    found = {name.removeprefix("backbone."): list(p.shape) for name, p in large.named_parameters() if name.startswith("backbone.")}
    differing = [name for name in found.keys() | released.keys() if found.get(name) != released.get(name)]
    assert not differing, differing


def lpips_is_the_authors():
    golden = load_file(GOLDENS / "lpips.safetensors")
    home = Path(os.environ.get("ZIPSPLAT_CACHE") or Path.home() / ".cache" / "zipsplat") / "lpips_vgg.safetensors"
    if not home.is_file():
        print(f"{home}: not there (tools/lpips.py fetches it): LPIPS was not compared")
        return
    # In f32, rounding picks the maximum among equal features of black pixels.
    distance = losses.Lpips(load_file(home)).double()
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
    for field in ("width", "ffn_hidden", "camera_hidden", "camera_pose_hidden", "fusion_hidden", "color_width", "color_hidden"):
        refused(changed(**{f"architecture__{field}": 2052}), f"architecture.{field}", "2052", "a multiple of 8")
    refused(changed(architecture__heads=5), "architecture.heads", "5", "width")
    refused(changed(architecture__head_hidden=600), "architecture.head_hidden", "600", "640")
    refused(changed(camera_rate=2), "camera_rate", "2")
    refused(changed(batch_scenes=4), "batch_scenes", "48")
    refused(changed(views_at_once=3), "views_at_once", "3", "4 views")
    refused(changed(record_views=5), "record_views", "5", "6 at least")
    refused(changed(warmup=0), "warmup", "0")
    refused(changed(warmup=1), "warmup", "1")
    refused(changed(size=90), "size", "90", "14")
    refused(changed(evaluate=[12, 2]), "evaluate", "12")
    refused(changed(gap=[9, 3]), "gap", "[9, 3]")
    refused(changed(muon="adam"), "muon", "adam")
    refused(changed(queries=-1), "queries", "-1")
    refused(changed(initial__coupled=1), "initial.coupled")
    refused(changed(queries=64), "losses.anchor", "learned queries")
    free = dict(queries=64, losses__anchor=0, losses__ray=0, losses__color=0)
    refused(changed(**free), "geometry_until")
    changed(**free, geometry_until=0, geometry_after=0)()
    refused(lambda: read_config(TRAIN / "pocket.json", ["quaries=3"]), "quaries")
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump({"base": str(TRAIN / "paper.json"), "losses": {"depht": 1}}, file)
        file.flush()
        refused(lambda: read_config(file.name), file.name, "depht")


def a_schedule_follows_the_share_that_is_done():
    schedule = Schedule(POCKET)
    assert schedule.rate(0) == 0 and schedule.rate(1) < 1e-9 and schedule.rate(0.03) == POCKET["learning_rate"]
    assert schedule.weights(0)["anchor"] == 1 and schedule.weights(0.6)["anchor"] == 0
    schedule, rng = Schedule(PAPER), random.Random(0)
    assert schedule.rate(0.05) == 3e-4 and abs(schedule.rate(0.025) - 1.5e-4) < 1e-9 and schedule.rate(1) < 1e-9
    assert {schedule.draw(0, rng) for _ in range(9)} == {(2, 1.0)}
    draws = [schedule.draw(0.5, rng) for _ in range(20_000)]
    assert {views for views, _ in draws} == set(range(2, 25))
    # Uniform between 0.5 sqrt(2 / N) and 1.
    for views in (2, 24):
        least, ratios = 0.5 * math.sqrt(2 / views), [ratio for n, ratio in draws if n == views]
        assert least <= min(ratios) < least + 0.02 and 0.98 < max(ratios) <= 1, (views, min(ratios), max(ratios))
        assert abs(sum(ratios) / len(ratios) - (1 + least) / 2) < 0.03, views
    assert max(schedule.draw(0.25, rng)[0] for _ in range(999)) == 13


TESTS = (
    gaussians_of_a_token_start_together_where_they_are_coupled,
    opacity_and_place_are_where_the_settings_say,
    each_number_of_gaussians_has_its_cells,
    learned_queries_are_as_many_whatever_the_scene,
    backbone_and_camera_encoder_have_rates_of_their_own,
    presets_have_the_published_settings,
    geometric_losses_are_as_written,
    a_released_backbone_sees_what_its_own_network_sees,
    vggt_starts_from_its_release_and_learns,
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
