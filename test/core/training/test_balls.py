from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gapr_core.data import anatomy as bones
from gapr_core.data import pool
from gapr_core.model.config import ModelConfig
from gapr_core.model.pyramid import build_cloud, pyramid, stage_radii, target_frame
from gapr_core.training import balls

MODELS = Path(__file__).parents[3] / "config" / "model"


def test_the_sizes_of_the_balls_equal_a_loop_over_every_two_points(toy):
    config = toy.small_config()
    frame = target_frame(toy.bone(), config)
    unit = (toy.bone() - toy.bone().mean(0)) / frame.scale_mm
    levels, radii = pyramid(unit, frame.voxel, config), stage_radii(frame.voxel, config)
    found = balls.ball_sizes(toy.bone(), frame.voxel, frame.scale_mm, config)
    for stage, points in enumerate(levels):
        centres = np.vstack(levels[stage : stage + 2])
        expected = (np.linalg.norm(centres[:, None] - points, axis=2) <= radii[stage]).sum(axis=1)
        np.testing.assert_array_equal(found[stage], expected)


def test_a_cap_that_cuts_nothing_gives_the_network_every_point_of_every_ball(toy):
    config = toy.small_config(neighbors=(200, 200, 200, 200))
    frame = target_frame(toy.bone(), config)
    cloud = build_cloud(toy.bone(), frame, config)
    sizes = balls.ball_sizes(toy.bone(), frame.voxel, frame.scale_mm, config)
    assert [int(s[: len(level.points)].sum()) for s, level in zip(sizes, cloud.levels, strict=True)] == [
        int(level.within.valid.sum()) for level in cloud.levels
    ]
    assert balls.share_cut(sizes, config.neighbors) == [0.0] * 4


def test_the_caps_for_a_share_are_the_smallest_that_keep_to_it():
    sizes = [np.arange(1, 101)]
    assert balls.caps_for(sizes, 0.05) == [95]
    assert balls.share_cut(sizes, [95]) == [0.05] and balls.share_cut(sizes, [94]) == [0.06]


@pytest.mark.parametrize("name", ["faithful", "faithful_small"])
def test_the_caps_of_the_paper_cut_at_most_one_ball_in_twenty_of_every_bone_and_stage(name, anatomy_folder):
    config = ModelConfig.from_yaml(MODELS / f"{name}.yaml")
    for bone in bones.BONES:
        people = pool.specimens(bone, "train", 3, anatomy_folder)[:3]
        cut = balls.share_cut(balls.bone_sizes(people, config), config.neighbors)
        assert max(cut) <= balls.MOST_CUT, f"{bone}: {cut}"


def test_the_command_prints_a_line_for_every_bone_and_stage(anatomy, capsys, monkeypatch):
    monkeypatch.setattr(bones, "BONES", ("femur",))
    assert balls.main(["--anatomy", str(anatomy), "--people", "1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 4 and lines[2].startswith("| femur (toy) | 0 |") and lines[2].endswith(" % |")
