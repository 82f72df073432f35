"""What workers of a command need, loaded and built once for all of them."""

import torch._dynamo  # noqa: F401  (an optimizer needs it)

from tactip_twin.learning import tune  # noqa: F401
from tactip_twin.sim.contact.fidelity import fidelity_named
from tactip_twin.sim.dataset import generate  # noqa: F401
from tactip_twin.tactip_model.mesh import build_mesh
from tactip_twin.tactip_model.presets import design_named

build_mesh(design_named("nominal-127").shape, fidelity_named("draft").mesh)
