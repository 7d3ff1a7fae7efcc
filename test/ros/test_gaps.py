"""Clouds that the middleware lost, detected from the numbers of their publishers."""

from __future__ import annotations

import numpy as np
import pytest
from harness import node_in_thread, wait_until
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from gapr_ros.node.gaps import DOUBTED, LOST_IN_A_ROW, MOST_PUBLISHERS, Gaps
from msg_adapters import xyz_to_cloud

GOOD = np.random.default_rng(1).normal(size=(300, 3)).astype("f4") * 0.02


@pytest.mark.parametrize(
    ("publishers", "numbers", "lost"),
    [
        (1, [1, 2, 3, 4], [0, 0, 0, 0]),
        (1, [7, 8, 9], [0, 0, 0]),
        (1, [1, 2, 5], [0, 0, 2]),
        (1, [1, 3, 5, 7], [0, 1, 2, 3]),
        (2, [100, 1, 101, 2, 102, 3], [0] * 6),
        (2, [100, 1, 103, 2, 104, 5], [0, 0, 2, 2, 2, 4]),
        (2, [1, 100, 2, 101, 3, 102], [0] * 6),
        (2, [1, 100, 2, 103, 3, 104, 7], [0, 0, 0, 2, 2, 2, 5]),
        (1, [1, 100, 2, 101, 3, 102], [0, 98, 0, 0, 0, 0]),
        (1, [2, 5, 4, 6], [0, 2, 1, 1]),
        (1, [1, 50, 51, 1, 2, 3], [0, 48, 48, 48, 48, 48]),
        (2, [5, 80, 200, 6, 81, 201], [0, 0, 119, 119, 0, 0]),
        (1, [1, 50, 1, 2, 20], [0, 48, 48, 48, 65]),
        (2, [1, 3, 4], [0, 1, 1]),
        (2, [1, 2 + LOST_IN_A_ROW, 3 + LOST_IN_A_ROW], [0, 20, 20]),
        (2, [1, 3 + LOST_IN_A_ROW, 2], [0, 0, 0]),
    ],
    ids=[
        "none", "joined late", "a gap", "every second", "two publishers", "two with gaps", "the lower number first",
        "the lower number first, with gaps", "a second one that is not known yet", "late", "started again", "three",
        "again, with gaps", "a gap, and a publisher that is silent", "a long one", "a longer one",
    ],
)  # fmt: skip
def test_missing_numbers_are_counted_for_each_publisher(publishers, numbers, lost):
    gaps = Gaps()
    assert np.cumsum([gaps.note(number, publishers) for number in numbers]).tolist() == lost


def test_a_gap_of_long_ago_is_not_doubted():
    gaps = Gaps()
    numbers = [1000, 1, 50, *range(51, 51 + DOUBTED), 1, 2]
    assert sum(gaps.note(number, 2) for number in numbers) == 48


def test_a_gap_that_was_none_is_taken_back_by_a_publisher_that_is_new_as_well():
    gaps = Gaps()
    assert [gaps.note(number, publishers) for number, publishers in ((1, 1), (100, 1), (50, 5))] == [0, 98, -98]


def test_publishers_that_came_and_went_are_forgotten():
    gaps = Gaps()
    for start in range(1000, 0, -10):
        gaps.note(start, 100)
    assert len(gaps._heard) == MOST_PUBLISHERS
    gaps.note(0, 0)
    assert len(gaps._heard) == 1, "the last one is gone before its last cloud is taken"


def test_a_second_publisher_that_has_sent_more_before_is_no_gap(blob_path, client, method):
    """Clouds that it sent to nobody are not lost."""

    def cloud():
        return xyz_to_cloud(GOOD, Header(frame_id="probe", stamp=client.node.get_clock().now().to_msg()))

    second = client.node.create_publisher(PointCloud2, "points", 10)
    for _ in range(50):
        second.publish(cloud())
    with node_in_thread(method, blob_path) as node:
        client.wait_for_state("active")
        wait_until(lambda: second.get_subscription_count() and node.count_publishers("/points") == 2)
        for publisher in (client.points, second) * 3:
            before = node.counters.received
            publisher.publish(cloud())
            wait_until(lambda before=before: node.counters.received == before + 1)
            assert node.counters.lost == 0
