"""Gymnasium environments of touch. Importing this package registers them; it needs the extra `rl`.

import gymnasium
import tactip_twin.control.environments

environment = gymnasium.make("tactip_twin/EdgeFollow-v0", observation_mode="tactile")
"""

from tactip_twin.tactip_model.errors import TactipError

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise TactipError("the environments need gymnasium: in the clone, .venv/bin/pip install -e '.[rl]'") from error

NAMES = ("EdgeFollow", "SurfaceFollow", "ObjectRoll")
"""Names of the environments, which are registered as tactip_twin/NAME-v0."""

_MODULES = {"EdgeFollow": "following", "SurfaceFollow": "following", "ObjectRoll": "rolling"}

for _name in NAMES:
    if f"tactip_twin/{_name}-v0" not in gymnasium.registry:
        gymnasium.register(f"tactip_twin/{_name}-v0", f"{__name__}.{_MODULES[_name]}:{_name}")
