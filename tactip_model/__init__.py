"""The TacTip sensor, in its own frame. Knows nothing of robots or objects."""

from tactip_twin.tactip_model import opengl, threads

opengl.choose_platform()
threads.choose_waiting()
