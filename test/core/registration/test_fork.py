"""A process that has registered can be forked, as web servers and data loaders do."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
LONGEST_S = 240  # a child that hangs never ends
FORKED = """
import os, sys
import numpy as np
import torch
torch.set_num_threads(2)
from gapr_core.data.parametric import make_bone
from gapr_core.registration.problem import source as sources
from gapr_core.registration.problem import target as targets
from gapr_core.registration.proposals.search import NormalAlignedSearch
from gapr_core.registration.fit.refinement import refine_fully
from gapr_core.registration.registrar import pretrained_network
from gapr_core.config import RegistrarConfig
from gapr_core.registration.fit.verification import verify

rng, config = np.random.default_rng(0), RegistrarConfig(num_threads=2)
points = make_bone("femur", 3).sample(6000, rng)[0]
target, source = targets.prepare(points), sources.prepare(points[points[:, 2] > np.quantile(points[:, 2], 0.6)])
proposer = {"network": pretrained_network, "search": lambda: NormalAlignedSearch(config.search, 2)}[sys.argv[1]]()

def register():
    poses = proposer.propose(source, target, np.random.default_rng(0))
    best = verify(poses, source, target, config.verification, 2).poses[0]
    return refine_fully(best, source.points, target, config.refinement, source.neighbours).T

before = register()
child = os.fork()
if child == 0:
    os._exit(0 if np.abs(register() - before).max() < 1e-3 else 7)
status = os.waitpid(child, 0)[1]
assert np.abs(register() - before).max() < 1e-3  # the parent goes on as before
sys.exit(os.waitstatus_to_exitcode(status))
"""


@pytest.mark.timeout(2 * LONGEST_S)
@pytest.mark.parametrize("proposer", ["search", "network"])
def test_a_fork_after_a_registration_registers_the_same(proposer):
    command = [sys.executable, "-c", FORKED, proposer]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            problem = process.communicate(timeout=LONGEST_S)[1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # the child as well
            pytest.fail("the forked process hangs")
    assert process.returncode == 0, problem
