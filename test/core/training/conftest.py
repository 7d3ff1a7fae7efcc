from __future__ import annotations

import numpy as np
import pytest
from toy_clouds import bone, config, toy  # noqa: F401


@pytest.fixture(scope="module")
def anatomy(tmp_path_factory):
    """Nine people with one made-up bone in vertex correspondence, in the layout of the anatomy folder."""
    from scipy.spatial import ConvexHull

    folder = tmp_path_factory.mktemp("anatomy")
    points = bone(400)
    faces = ConvexHull(points).simplices
    rng = np.random.default_rng(0)
    people = np.stack([points * rng.uniform(0.8, 1.2, 3) for _ in range(9)]).astype(np.float32)
    names = [f"p{i}" for i in range(9)]
    np.savez(folder / "femur_toy.npz", points=people, faces=faces, person=np.array(names))
    (folder / "splits.json").write_text(
        '{"train": ["p0", "p1", "p2", "p3", "p4"], "val": ["p5", "p6"], "test": ["p7", "p8"]}'
    )
    return folder
