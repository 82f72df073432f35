"""The network's prediction for commands that show it beside an image."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from tactip_twin.tactip_model.errors import TactipError

if TYPE_CHECKING:
    import numpy as np

    from tactip_twin.tactip_model.design import Design


def load_pose_reader(name: str, task: str, design: "Design") -> "Callable[[np.ndarray], dict[str, float]] | None":
    """Return the function from a tactile image to the predicted pose by component, mm and degrees, or None.

    Args:
        name: A network, `none`, or empty for the shipped network of task and design.
        task: Stimulus of the scene.
        design: Design of the sensor.

    Raises:
        TactipError: There is no such network, or it takes images of another size or kind.
    """
    from tactip_twin.learning.data import kind_of
    from tactip_twin.learning.model import load_network, shipped_models

    chosen = name or f"{task}-{design.name}"
    if name == "none" or not (name or chosen in shipped_models()):
        return None
    model, made = load_network(chosen), design.image
    if (model.size, model.grey) != (made.size_px, made.grey):
        if not name:
            return None
        raise TactipError(
            f"the network {chosen} expects {kind_of(model.grey)} images of {model.size} px, but the design produces "
            f"{kind_of(made.grey)} ones of {made.size_px} px"
        )
    return lambda image: dict(zip(model.labels.components, model.predict(image[None])[0].tolist(), strict=True))
