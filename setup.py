"""The metadata of the package: for pip and, through ament_python, for colcon."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "gapr_ros"

CORE = ["matplotlib", "numba", "numpy", "open3d>=0.18", "plotly>=5.20", "plyfile", "rich", "scipy>=1.10", "tqdm", "vtk"]
NETWORK = ["safetensors", "torch>=2.4,<2.14"]
BASELINES = ["kiss-matcher; python_version < '3.13'", "pycpd", "small_gicp"]
BAGS = ["rosbags>=0.10"]
ROS_WHEELS = ["ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-common-interfaces"]
TEST = [
    "colcon-common-extensions",
    "hypothesis",
    "import-linter",
    "psutil",
    "pytest>=7.4",
    "pytest-timeout",
    "pytest-xdist",
    "ruff",
    "setuptools<80",  # later ones no longer have the commands that colcon calls
]


def files(folder, *patterns):
    """The data_files entry that installs these files of a folder into share/gapr_ros."""
    found = [path for pattern in patterns for path in sorted(glob(f"{folder}/{pattern}"))]
    return f"share/{PACKAGE}/{folder}", found


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Partial-to-full registration of bones with a calibrated confidence: library, command line, ROS 2 node",
    long_description=Path("README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="GAPR maintainers",
    maintainer_email="maintainers@gapr.invalid",
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=["gapr_core*", "msg_adapters*", "gapr_ros*"]),
    package_data={"gapr_core": ["weights/*.safetensors", "weights/*.json", "weights/*.md", "evaluation/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        files("config", "*.yaml"),
        files("config/model", "*.yaml"),
        files("launch", "*.launch.py"),
        files("rviz", "*.rviz"),
    ],
    install_requires=[*CORE, *NETWORK, "pyyaml"],
    extras_require={
        "bags": BAGS,
        "ros": [*ROS_WHEELS, *BAGS],
        "baselines": BASELINES,
        "test": TEST,
        "dev": [*TEST, "mypy", "pre-commit", "types-PyYAML"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "gapr = gapr_core.cli:main",
            "register_node = gapr_ros.register_node:main",
            "bag_replay = gapr_ros.bag_replay:main",
        ],
        "gapr.commands": [
            "ablate = gapr_core.training.ablation",
            "benchmark = gapr_core.evaluation.benchmark",
            "demo = gapr_ros.demo",
            "make-pairs = gapr_core.data.make_pairs",
            "train = gapr_core.training.cli",
        ],
    },
)
