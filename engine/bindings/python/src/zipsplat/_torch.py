"""Differentiable rasterization for torch."""

from __future__ import annotations

from typing import Any, Optional, Sequence

import numpy as np
import torch

from . import _rasterize


class Torch:
    """Tensor operations on the host; results return to the tensors' device."""

    def __init__(self, device: Any) -> None:
        self.device = device
        # The same GPU by default.
        self.selector = device if device.type == "cuda" else None

    def array(self, values: Any) -> Any:
        return torch.as_tensor(values).to("cpu", torch.float32)

    concatenate = staticmethod(torch.cat)
    ones_like = staticmethod(torch.ones_like)

    @staticmethod
    def lowest(values: Any) -> float:
        return float(values.detach().min()) if values.numel() else 0.0

    @staticmethod
    def host(values: Any) -> Any:
        return values.detach().numpy()

    def described(self, values: Any) -> Any:
        return torch.from_numpy(values).to(self.device)

    def result(self, values: Any) -> Any:
        return values.to(self.device)

    def means2d(self, meta: dict[str, Any], shape: tuple[int, ...], inputs: Sequence[Any]) -> Any:
        """Makes means2d of the metadata a leaf; returns it as [batches, C, N, 2] on the host."""
        if not torch.is_grad_enabled() or not any(tensor.requires_grad for tensor in inputs):
            return None
        leaf = meta["means2d"].requires_grad_()
        if meta["gaussian_ids"] is None:
            return leaf.reshape(shape).to("cpu")
        ids = tuple(meta[f"{name}_ids"] for name in ("batch", "camera", "gaussian"))
        return torch.zeros(shape, device=self.device).index_put(ids, leaf).to("cpu")

    @staticmethod
    def rasterize(
        settings: Any,
        geometry: Sequence[Any],
        coeffs: Optional[Any],
        viewmats: Any,
        Ks: Any,
        depth: bool,
        means2d: Any,
    ) -> tuple[Any, Any, Any]:
        found = _Rasterize.apply(settings, depth, Ks, viewmats, means2d, coeffs, *geometry)
        rgb = None if coeffs is None else found[0]
        return rgb, found[1], found[2] if depth else None


class _Rasterize(torch.autograd.Function):  # type: ignore[misc]
    """Gaussians and cameras to colors, alphas and accumulated depths."""

    @staticmethod
    def forward(
        context: Any, settings: Any, depth: bool, Ks: Any, viewmats: Any, _means2d: Any, coeffs: Any, *geometry: Any
    ) -> tuple[Any, ...]:
        context.settings, context.depth, context.color = settings, depth, coeffs is not None
        context.save_for_backward(Ks, viewmats, *([] if coeffs is None else [coeffs]), *geometry)
        context.set_materialize_grads(False)
        arrays = [tensor.detach().numpy() for tensor in geometry]
        colors = None if coeffs is None else coeffs.detach().numpy()
        planes = _rasterize.forward(settings, arrays, colors, viewmats.detach().numpy(), Ks.detach().numpy(), depth)
        return tuple(torch.zeros(0) if plane is None else torch.from_numpy(plane) for plane in planes)

    @staticmethod
    def backward(context: Any, *d_planes: Any) -> tuple[Any, ...]:
        Ks, viewmats, *rest = context.saved_tensors
        coeffs = rest.pop(0) if context.color else None
        asked = [context.color, True, context.depth]
        weights = [d.numpy() if wanted and d is not None else None for wanted, d in zip(asked, d_planes)]
        found, by_viewmats = _rasterize.backward(
            context.settings,
            [tensor.detach().numpy() for tensor in rest],
            None if coeffs is None else coeffs.detach().numpy(),
            viewmats.detach().numpy(),
            Ks.detach().numpy(),
            weights,
            bool(context.needs_input_grad[3]),
            bool(context.needs_input_grad[4]),
        )
        fields = ["means", "quats", "scales", "opacities"]
        geometry = [torch.from_numpy(found[name]) for name in fields]
        by_coeffs = torch.from_numpy(found["sh_coeffs"]) if context.color else None
        by_means2d = torch.from_numpy(found["means2d"]) if "means2d" in found else None
        by_views: Optional[Any] = None if by_viewmats is None else torch.from_numpy(np.asarray(by_viewmats))
        return (None, None, None, by_views, by_means2d, by_coeffs, *geometry)
