"""How the threads of numerical libraries wait: chosen before they load, unless the user has chosen."""

import os
import subprocess
import sys

import pytest

from tactip_twin.commands.main import main


@pytest.mark.parametrize(
    ("module", "chosen", "spins", "policy"),
    [
        ("learning.model", {}, "'1000'", None),
        ("sim.tactip", {}, "'1000'", None),
        ("sim.pose", {"GOMP_SPINCOUNT": "77"}, "'77'", None),
        ("sim.pose", {"OMP_WAIT_POLICY": "ACTIVE"}, None, "'ACTIVE'"),
    ],
)
def test_threads_sleep_soon_unless_user_has_chosen(module, chosen, spins, policy):
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_WAIT", "GOMP_"))}
    environment |= {"OMP_DISPLAY_ENV": "VERBOSE"} | chosen
    code = f"import tactip_twin.{module}, torch"
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    shown = dict(line.strip().split(" = ", 1) for line in run.stderr.splitlines() if " = " in line)
    if not shown:
        pytest.skip("torch does not use GNU's OpenMP here")
    assert shown["OMP_WAIT_POLICY"] == (policy or shown["OMP_WAIT_POLICY"])
    assert spins is None or shown["GOMP_SPINCOUNT"] == spins
    assert spins is not None or shown["GOMP_SPINCOUNT"] != "'1000'"


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="counts threads as Linux does")
@pytest.mark.parametrize("chosen", [{}, {"OPENBLAS_NUM_THREADS": "2"}, {"OMP_NUM_THREADS": "2"}], ids=str)
def test_numpy_multiplies_in_one_thread_unless_user_has_chosen(chosen):
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | chosen
    code = "import os, tactip_twin.sim.pose, numpy as np; a = np.ones((999, 999)); a @ a; "
    code += "print(len(os.listdir('/proc/self/task')))"
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert (int(run.stdout) > 1) == (bool(chosen) and len(os.sched_getaffinity(0)) > 1)


@pytest.mark.parametrize("count", ["0", "-1", "1000000"])
@pytest.mark.parametrize("command", ["train --data {0} --out {0}/out", "evaluate --model surface-tactip-127 --data {0}"])
def test_number_of_threads_is_bounded_by_cores(tmp_path, capsys, command, count):
    status = main([*command.format(tmp_path).split(), "--threads", count])
    assert status == 1
    assert "--threads must be from 1 to the number of cores" in capsys.readouterr().err
