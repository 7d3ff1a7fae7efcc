"""The node as users start it: its own process, the real registration, DDS, bags, signals."""

from __future__ import annotations

import bones
import numpy as np
import pytest
from harness import PATIENCE_S, Client, NodeProcess, context, pose_mm, wait_until
from lifecycle_msgs.msg import Transition
from rclpy.node import Node

from gapr_core.geometry import se3
from gapr_ros.bags.files import open_bag
from gapr_ros.bags.replay import Replay, ReplayOptions
from gapr_ros.bags.writing import BagWriter
from gapr_ros.node import units
from msg_adapters import list_to_covariance, pose_to_matrix


@pytest.fixture(scope="module")
def bone():
    return bones.bone()


@pytest.fixture(scope="module")
def live(bone, tmp_path_factory):
    """One node process and one client for the whole file."""
    folder = tmp_path_factory.mktemp("node")
    model = bones.save(bone, folder / "bone.npz")
    client = Client()
    node = NodeProcess(folder, model_path=model, model_unit="mm", keeps=True)
    client.wait_for_state("active")
    yield node, client
    client.close()
    assert node.stop() == 0, node.log
    assert "Traceback" not in node.log and "failed" not in node.log, node.log


@pytest.mark.parametrize("seed", range(3))
def test_a_partial_cloud_gives_the_true_pose(live, bone, seed):
    node, client = live
    client.poses.clear()
    rng = np.random.default_rng(seed)
    T = se3.from_rotation_translation(se3.random_rotation(rng), rng.uniform(-150.0, 150.0, 3))
    cloud = bones.partial(bone, T, seed)
    values = client.ask(cloud)
    assert values["level"] == 0, values
    wait_until(lambda: client.poses)
    estimate = units.core_pose(pose_to_matrix(client.poses[0]))
    translation_mm, rotation_deg = se3.pose_error(estimate, T, cloud * 1000.0)
    assert translation_mm < 1.0 and rotation_deg < 1.0
    assert float(values["confidence"]) >= 0.5
    covariance = list_to_covariance(client.poses[0].pose.covariance)
    np.linalg.cholesky(covariance)
    assert (np.sqrt(covariance.diagonal()[:3]) < 0.02).all() and (np.sqrt(covariance.diagonal()[3:]) < 0.1).all()


def test_the_next_cloud_is_looked_for_where_the_last_one_was_until_a_reset(live, bone):
    _, client = live
    T = pose_mm([0.1, 0.2, -0.9], [30.0, 20.0, 90.0])
    nearby = se3.exp([4.0, -3.0, 2.0, 0.03, 0.02, -0.04]) @ T
    client.call("reset")
    clouds = [bones.partial(bone, T, 21), bones.partial(bone, nearby, 22)]
    assert client.ask(clouds[0])["found_by"] in ("network", "search")
    client.poses.clear()
    assert client.ask(clouds[1])["found_by"] == "track"
    wait_until(lambda: client.poses)
    estimate = units.core_pose(pose_to_matrix(client.poses[0]))
    translation_mm, rotation_deg = se3.pose_error(estimate, nearby, clouds[1] * 1000.0)
    assert translation_mm < 1.0 and rotation_deg < 1.0
    client.call("reset")
    assert client.ask(clouds[1])["found_by"] in ("network", "search")


def test_noise_is_refused_by_the_real_registration(live):
    node, client = live
    client.poses.clear()
    values = client.ask(np.random.default_rng(0).uniform(-0.1, 0.1, (2000, 3)))
    assert values["last_refusal"].split(":")[0] in {"ambiguous", "clutter", "degenerate", "low_confidence"}, values
    assert not client.poses
    assert node.process.poll() is None


def test_every_cloud_of_a_replayed_bag_is_answered_or_counted(live, bone, tmp_path):
    node, client = live
    T = pose_mm([0.4, -0.9, 1.3], [80.0, 10.0, -60.0])
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(12):
            bag.write_cloud("/points", bones.partial(bone, T, i), "probe", (2_000_000_000 + i * 150_000_000))
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE):  # forgets earlier publishers
        assert client.change_state(transition)
    client.call("reset")  # the stamps of the bag are older
    before = client.values()

    def gone():
        return {key: int(client.values()[f"frames_{key}"]) - int(before[f"frames_{key}"]) for key in KINDS}

    play(tmp_path / "bag", lambda *_: wait_until(lambda: gone()["received"], PATIENCE_S, "the first cloud"))
    wait_until(lambda: gone()["received"] >= 11, PATIENCE_S, gone)  # the first may come before the node is discovered
    wait_until(
        lambda: sum(gone()[k] for k in ("accepted", "refused", "dropped")) == gone()["received"], PATIENCE_S, gone
    )
    assert gone()["refused"] == 0 and gone()["accepted"] >= 1, client.values()


KINDS = ("received", "accepted", "refused", "dropped")


def play(path, on_message):
    ros = context()
    node, bag = Node("player", context=ros), open_bag(path)
    Replay(node, bag, ReplayOptions(progress=False, wait_s=60.0), on_message).run()
    bag.reader.close()
    node.destroy_node()
    ros.try_shutdown()
