"""Names of the arm models, for options and signatures: importing this module loads no physics."""

from typing import Literal

ArmName = Literal["none", "kinematic", "dynamic"]
"""Name of an arm model (arm_models.py): no arm, an arm with kinematics only, or one with masses and motors too."""
