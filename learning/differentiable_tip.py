"""The learned tip in torch: pins as a differentiable function of motion, materials and pin length (sim/fast_tip/)."""

import numpy as np
import torch

from tactip_twin.sim.fast_tip.fast_tip import FastTip
from tactip_twin.sim.fast_tip.materials import INPUTS, material_inputs
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.pins import neutral_pins, pin_lever_m

_MM, _DEG = 1e3, float(np.degrees(1.0))


class DifferentiableTip(torch.nn.Module):
    """Pins of contacts, with derivatives by all that they depend on. It has no trainable parameters."""

    center: torch.Tensor
    scale: torch.Tensor
    coefficient_scale: torch.Tensor
    orders: torch.Tensor
    moved: torch.Tensor
    turned: torch.Tensor
    tips: torch.Tensor
    directions: torch.Tensor
    lever_m: torch.Tensor
    own_materials: torch.Tensor

    def __init__(self, tip: FastTip, design: Design, dtype: torch.dtype = torch.float32) -> None:
        """Take over a learned tip.

        Args:
            tip: The learned tip.
            design: Design of the sensor.
            dtype: Type of its numbers.

        Raises:
            TactipError: The tip does not know this design.
        """
        super().__init__()
        tip.check_design(design)
        self._edge, self.knows_materials = tip.task == "edge", tip.materials is not None
        tips, directions = neutral_pins(design)
        moved, turned = tip.modes.at(-directions)
        arrays = {
            "center": tip.center,
            "scale": tip.scale,
            "coefficient_scale": tip.coefficient_scale,
            "orders": tip.modes.orders,
            "moved": moved,
            "turned": turned,
            "tips": tips,
            "directions": directions,
            "lever_m": pin_lever_m(design),
            "own_materials": material_inputs(design.materials),
        }
        for k, network in enumerate(tip.networks):
            arrays |= network.arrays(f"network{k}")
        for name, array in arrays.items():
            self.register_buffer(name, torch.as_tensor(np.asarray(array), dtype=dtype))
        self._members = [len(network.weights) for network in tip.networks]

    def forward(
        self,
        poses: torch.Tensor,
        shears: torch.Tensor,
        materials: torch.Tensor | None = None,
        pin_length_change_m: torch.Tensor | float = 0.0,
    ) -> torch.Tensor:
        """Return pin tips (k, p, 3), m, in the sensor frame.

        Args:
            poses: (k, 6) m and rad.
            shears: (k, 6) m and rad.
            materials: sim/fast_tip/materials.INPUTS (k, 6), or (6,); None for the design's. Of a tip that knows one design
                only, they are ignored.
            pin_length_change_m: Pin length minus the design's, m.
        """
        values, yaw = self._features(poses, shears)
        if self.knows_materials:
            known = self.own_materials if materials is None else materials
            values = torch.cat([values, known.expand(len(values), len(INPUTS))], 1)
        scaled = (values - self.center) / self.scale
        outputs = sum(self._network(k, scaled) for k in range(len(self._members))) / len(self._members)
        parts = outputs * self.coefficient_scale
        real, imaginary = parts.chunk(2, 1)
        # A turn by an angle a multiplies the coefficients by exp(-i m a) (skin_field.py).
        cosine, sine = torch.cos(yaw[:, None] * self.orders), torch.sin(yaw[:, None] * self.orders)
        parts = torch.cat([real * cosine + imaginary * sine, imaginary * cosine - real * sine], 1)
        to_tips = self.moved - (self.lever_m + pin_length_change_m) * self.turned
        # A longer pin ends farther inside.
        neutral = self.tips + pin_length_change_m * self.directions
        return neutral + torch.einsum("km,mpx->kpx", parts, to_tips)

    def _features(self, poses: torch.Tensor, shears: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return features (k, COUNT) and yaw (k,): see sim/fast_tip/features.py."""
        into_label = rotation_matrix(-poses[:, 3:])
        yaw = torch.zeros_like(poses[:, 0])
        if self._edge:
            yaw = torch.atan2(-into_label[:, 0, 1], into_label[:, 1, 1])
        upright = torch.stack([torch.zeros_like(yaw), torch.zeros_like(yaw), -yaw], 1)
        into_axes = rotation_matrix(upright) @ into_label
        turned = [(into_axes @ vectors[:, :, None])[:, :, 0] for vectors in (shears[:, :3], shears[:, 3:])]
        columns = [_MM * poses[:, 2:3], 10 * into_axes[:, :2, 2], _MM * turned[0], _DEG * turned[1]]
        if self._edge:
            columns.insert(0, _MM * poses[:, :1])
        return torch.cat(columns, 1), yaw

    def _network(self, member: int, x: torch.Tensor) -> torch.Tensor:
        """Return the outputs of one network: see sim/fast_tip/network.py."""
        weights = [getattr(self, f"network{member}_{k}") for k in range(self._members[member])]
        pairs = list(zip(weights[::2], weights[1::2], strict=True))
        linear, silu = torch.nn.functional.linear, torch.nn.functional.silu
        hidden = silu(linear(x, *pairs[0]))
        for matrix, bias in pairs[1:-1]:
            hidden = hidden + silu(linear(hidden, matrix, bias))
        out = linear(hidden, *pairs[-1])
        skip = getattr(self, f"network{member}_skip", None)
        return out if skip is None else out + x @ skip.T


def rotation_matrix(vectors: torch.Tensor) -> torch.Tensor:
    """Return the rotation matrices (k, 3, 3) of rotation vectors (k, 3), rad; differentiable at zero, too."""
    x, y, z = vectors.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return torch.linalg.matrix_exp(cross)
