"""A learned tip as the start of another's training: with the inputs and the scale of forces of the other's contacts."""

import dataclasses

import numpy as np
import torch

from tactip_twin.learning.tip_networks import Perceptron
from tactip_twin.sim.fast_tip.fast_tip import REFERENCE_YOUNG_PA, FastTip
from tactip_twin.sim.fast_tip.features import COUNT
from tactip_twin.sim.fast_tip.materials import check_mechanics, material_inputs, mechanics_of
from tactip_twin.sim.fast_tip.network import Network
from tactip_twin.sim.labels import Task
from tactip_twin.tactip_model.design import Design
from tactip_twin.tactip_model.errors import TactipError


def started_from(tip: FastTip, task: Task, design: Design, materials: np.ndarray | None) -> FastTip:
    """Return a learned tip with the inputs of other contacts, which predicts them as before.

    A tip of one design gets the materials as inputs without an effect; one of any materials keeps those of the design.

    Args:
        tip: The learned tip.
        task: Task of the contacts.
        design: Design of the contacts.
        materials: (k, 6), materials.INPUTS of the contacts; None if all are of the design.

    Raises:
        TactipError: The tip is of another task or shape.
    """
    if tip.task != task:
        raise TactipError(f"the learned tip to start from is for {tip.task}, got contacts of {task}")
    check_mechanics({"shape": tip.mechanics["shape"]}, design)
    mechanics = mechanics_of(design, materials is not None)
    if (tip.materials is None) == (materials is None):
        return dataclasses.replace(tip, mechanics=mechanics)
    count, networks = COUNT[task], (*tip.networks, tip.measure_network)
    if materials is not None:
        center = np.concatenate([tip.center, materials.mean(0)])
        scale = np.concatenate([tip.scale, np.maximum(materials.std(0), 1e-6)])
        networks = [_with_first(n, np.pad(n.weights[0], ((0, 0), (0, materials.shape[1]))), n.weights[1]) for n in networks]
        stiffness = tip.mechanics["materials"]["gel_young_pa"] / REFERENCE_YOUNG_PA
    else:
        center, scale = tip.center[:count], tip.scale[:count]
        kept = (material_inputs(design.materials) - tip.center[count:]) / tip.scale[count:]
        networks = [_with_first(n, n.weights[0][:, :count], n.weights[1] + n.weights[0][:, count:] @ kept) for n in networks]
        stiffness = REFERENCE_YOUNG_PA / design.materials.gel_young_pa
    measure_center = tip.measure_center.copy()
    measure_center[0] -= np.log(stiffness)
    return dataclasses.replace(
        tip,
        mechanics=mechanics,
        center=center,
        scale=scale,
        networks=tuple(networks[:-1]),
        measure_network=networks[-1],
        measure_center=measure_center,
        materials=None if materials is None else np.stack([materials.min(0), materials.max(0)], 1),
    )


def perceptron_of(network: Network) -> Perceptron:
    """Return a network, which has no skip, for training."""
    matrices = network.weights[::2]
    out = Perceptron(matrices[0].shape[1], len(matrices[0]), len(matrices) - 2, len(matrices[-1]))
    # Parameters by name: weight, then bias, of each layer.
    parameters = [p for layer in (out.first, *out.residual, out.last) for p in layer.parameters()]
    with torch.no_grad():
        for parameter, values in zip(parameters, network.weights, strict=True):
            parameter.copy_(torch.tensor(values))
    return out


def _with_first(network: Network, matrix: np.ndarray, bias: np.ndarray) -> Network:
    """Return a network with another matrix and bias of its first layer."""
    first = (matrix.astype(np.float32), bias.astype(np.float32))
    return dataclasses.replace(network, weights=(*first, *network.weights[2:]))
