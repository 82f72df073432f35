"""What a network feels of an image, for commands that show it."""

from tactip_twin.tactip_model.errors import TactipError


def reader_of(name, task, design):
    """The function of a tactile image to what a network feels (dict by component), or None.

    name: str, as of the option `model`. task: str. design: Design.
    """
    from tactip_twin.learning.model import find_model, shipped_models

    chosen = name or f"{task}-{design.name}"
    if name == "none" or not (name or chosen in shipped_models()):
        return None
    model, made = find_model(chosen), design.image.size_px
    if model.size != made:
        raise TactipError(f"the network {chosen} takes images of {model.size} px, and the design makes {made}")
    return lambda image: dict(zip(model.labels.components, model.predict(image[None])[0].tolist(), strict=True))
