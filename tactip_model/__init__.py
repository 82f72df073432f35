"""The TacTip sensor, in its own frame. Knows nothing of robots or objects."""

from tactip_twin.tactip_model import opengl

opengl.choose_platform()
