"""The training objective of a batch: forward pass, rendering, losses, gradients."""

import torch

import losses
from rasterize import rasterize


class Objective:
    """`perceptual` is LPIPS or None; `blend` replaces the default renderer of `rasterize`."""

    def __init__(self, config, perceptual=None, blend=None):
        self.config, self.perceptual, self.blend = config, perceptual, blend

    def at_once(self, scenes, views):
        """Returns how many of `scenes` fit `views_at_once`, which bounds the memory."""
        most = self.config["views_at_once"]
        return min(max(most // views, 1), scenes) if most else scenes

    def forward(self, model, data, ratio, given, draw=True):
        """Returns Gaussians, the kept tokens, and pictures of the targets if `draw`."""
        with torch.autocast(data.images.device.type, torch.bfloat16, enabled=self.config["bf16"]):
            gaussians, tokens = model(data.images, ratio, (data.poses, data.intrinsics), given)
        if not draw:
            return gaussians, tokens, None
        cameras = (data.viewmats, data.target_intrinsics, data.colors.shape[2:4])
        return gaussians, tokens, rasterize(gaussians, *cameras, self.config["architecture"]["sh_degree"], self.blend)

    def backward(self, model, data, ratio, given, weights, draw=True):
        """Adds the gradients of the batch's mean loss, part by part; returns mean measurements."""
        scenes = len(data.images)
        most, means = self.at_once(*data.images.shape[:2]), {}
        for start in range(0, scenes, most):
            part = type(data)(*(value[start : start + most] for value in data))
            share = len(part.images) / scenes
            for name, value in self.backward_part(model, part, ratio, given[start : start + most], weights, draw, share).items():
                means[name] = means.get(name, 0) + share * value
        return means

    def backward_part(self, model, data, ratio, given, weights, draw, share):
        gaussians, tokens, pictures = self.forward(model, data, ratio, given, draw)
        loss, parts = losses.total(gaussians, tokens, pictures, given, data, weights, self.config, self.perceptual)
        (share * loss).backward()
        with torch.no_grad():
            parts |= {"loss": loss, "median_scale": gaussians[:, ::7, 3:6].median()}
            if draw:
                error = (pictures.rgb.clamp(0, 1) - data.colors).square().mean((1, 2, 3, 4))
                parts |= {"psnr": -10 * error.log10().mean(), "reached": pictures.reached.float().mean()}
            return {name: value.detach() for name, value in parts.items()}
