"""A parameter file that is for another node is warned of; what rclpy takes from the same file is the reference."""

from __future__ import annotations

import pytest
from harness import DOMAIN, NodeProcess, wait_until
from rclpy.context import Context
from rclpy.node import Node

from gapr_ros.register_node import files_in, without_entry

NODE = "/femur/register_node"
ENTRY = "{ros__parameters: {autostart: false}}"
NAMES = [
    *("/**", "**", "/*", "*", "/*/*", "*/*", "/**/*", "/femur/*", "/femur/**", "/**/femur/**", "/tibia/*", "/femur"),
    *("/**/register_node", "/*/register_node", "/femur/*/register_node", "/femur/**/register_node"),
    *("/femur/register_node/**", "/**/register_node/**", "/left/femur/register_node", "/tibia/register_node"),
    *("/femur/register_node", "femur/register_node", "/register_node", "register_node", "/FEMUR/register_node"),
    "/femur/register_node2",
]
TEXTS = [
    *(f'"{name}": {ENTRY}' for name in NAMES),
    f"femur: {{register_node: {ENTRY}}}",
    f"/: {{femur: {{register_node: {ENTRY}}}}}",
    f"/femur/: {{register_node: {ENTRY}}}",
    f'femur: {{"*": {ENTRY}}}',
    f'"/**": {{register_node: {ENTRY}}}',
    f"femur: {{tracker: {ENTRY}}}",
    f"femur: {{register_node: {ENTRY}}}\nfemur: {{tracker: {ENTRY}}}",
    f"tracker: {ENTRY}\ncamera: {ENTRY}\n/femur/register_node: {ENTRY}",
    f"true: {ENTRY}",
    "# nothing",
    "",
]


@pytest.mark.parametrize("node", [NODE, "/register_node"])
@pytest.mark.parametrize("text", TEXTS)
def test_a_file_is_warned_of_where_rclpy_takes_nothing_from_it(tmp_path, text, node):
    path, ros = tmp_path / "mine.yaml", Context()
    path.write_text(text)
    namespace, _, name = node.rpartition("/")
    arguments = ["--ros-args", "--params-file", str(path), "-r", f"__ns:={namespace or '/'}"]
    ros.init(args=arguments, domain_id=DOMAIN)
    reference = Node(name, context=ros, start_parameter_services=False)
    assert reference.get_fully_qualified_name() == node
    assert bool(without_entry(arguments, node)) is not bool(reference._parameter_overrides)
    reference.destroy_node()
    ros.try_shutdown()


@pytest.mark.parametrize(("text", "has"), [
    (f"register_node: {ENTRY}", "register_node"),
    (f"camera: {{left: {ENTRY}, right: {ENTRY}}}", "camera/left, camera/right"),
    ("\n".join(f"/node{i}: {ENTRY}" for i in range(6)), "/node0, /node1, /node2, /node3, /node4, ..."),
    ("", "none"),
])  # fmt: skip
def test_the_warning_names_the_file_the_node_and_what_the_file_has(tmp_path, monkeypatch, text, has):
    (tmp_path / "mine.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    sentences = without_entry(["--ros-args", "--params-file", "mine.yaml"], NODE)
    assert sentences == [f"no entry of mine.yaml is for {NODE}: it has {has}; write that name, or /**, in it"]


def test_an_entry_without_parameters_is_one(tmp_path):
    (tmp_path / "mine.yaml").write_text(f"{NODE}: {{ros__parameters: {{}}}}\n")
    assert not without_entry(["--ros-args", "--params-file", str(tmp_path / "mine.yaml")], NODE)


@pytest.mark.parametrize("content", [None, b"a: {", b"\xff\xfe\x00", b"a: 1\n---\nb: 2\n"])
def test_a_file_that_cannot_be_read_is_left_to_rcl(tmp_path, content):
    if content is not None:
        (tmp_path / "mine.yaml").write_bytes(content)
    assert not without_entry(["--ros-args", "--params-file", str(tmp_path / "mine.yaml")], NODE)


@pytest.mark.parametrize(("words", "files"), [
    ("--params-file a.yaml", []),
    ("--ros-args --params-file a.yaml -p x:=1 --params-file b.yaml", ["a.yaml", "b.yaml"]),
    ("--ros-args --params-file a.yaml -- --params-file b.yaml --ros-args --params-file c.yaml", ["a.yaml", "c.yaml"]),
    ("--ros-args --params-file", []),
])  # fmt: skip
def test_files_are_those_of_the_part_that_is_for_ros(words, files):
    assert list(files_in(["register_node", *words.split()])) == files


@pytest.mark.parametrize(("remapped", "node"), [("__ns:=/femur", NODE), ("__node:=femur_node", "/femur_node")])
def test_the_node_warns_of_a_file_whose_limits_it_does_not_have(tmp_path, remapped, node):
    mine, shared = tmp_path / "mine.yaml", tmp_path / "shared.yaml"
    mine.write_text("register_node: {ros__parameters: {max_tre: 0.002}}\n")
    shared.write_text(f"/**: {ENTRY}\n/tracker: {ENTRY}\n")
    given = ["--ros-args", "--params-file", str(mine), "--params-file", str(shared), "-r", remapped]
    process = NodeProcess(tmp_path, *given)
    expected = f"no entry of {mine} is for {node}: it has register_node"
    wait_until(lambda: expected in process.log, 60.0, lambda: process.log)
    assert process.stop() == 0, process.log
    assert "[WARN]" in process.log and "shared.yaml" not in process.log
