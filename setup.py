"""The metadata of the package: for pip and, through ament_python, for colcon."""

import os
import re
import subprocess
import sys
import sysconfig
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

PACKAGE = "gapr_ros"
URL = "https://gapr.invalid/gapr"
HERE = Path(__file__).resolve().parent  # `colcon build --symlink-install` runs a link to this file, elsewhere

CORE = [
    "libigl>=2.6",  # exact distances to a mesh
    "numba",
    "numpy",
    "plyfile",
    "pyyaml",
    "scipy>=1.10",
    "threadpoolctl>=3.1",
    "tqdm",
]  # what a registration by the search needs
NETWORK = ["safetensors", "torch>=2.4,<2.14"]
DATA = ["open3d>=0.18"]  # rays and distances of simulated bones
REPORTS = ["jinja2>=3.1", "matplotlib>=3.7", "pillow", "rich"]
BASELINES = [*DATA, "kiss-matcher; python_version < '3.13'", "pycpd", "small_gicp"]
MEDICAL = ["SimpleITK>=2.3", "highdicom>=0.24", "scikit-image>=0.22"]
RERUN = ["rerun-sdk>=0.23"]
BAGS = ["rosbags>=0.10"]
CLUSTER = ["distributed>=2024.1"]
ROS_WHEELS = ["ros-jazzy-rclpy", "ros-jazzy-rmw-fastrtps-cpp", "ros-jazzy-common-interfaces"]
TEST = [
    *CLUSTER,
    *MEDICAL,
    "colcon-common-extensions",
    "hypothesis",
    "nibabel",  # writes NIfTI headers as TotalSegmentator does
    "pyigtl",
    "import-linter",
    "psutil",
    "pytest>=7.4",
    "pytest-timeout",
    "pytest-xdist",
    "ruff",
    "setuptools<80",  # later ones no longer have the commands that colcon calls
    "vtk",  # writes the files that the project's own readers are held against
]
DOCS = ["mkdocs-jupyter>=0.25", "mkdocs-material>=9.5", "mkdocstrings[python]>=0.26"]


def files(folder, *patterns):
    """The data_files entry that installs these files of a folder into share/gapr_ros."""
    found = [path for pattern in patterns for path in sorted(glob(f"{folder}/{pattern}"))]
    return f"share/{PACKAGE}/{folder}", found


def readme():
    """The README with links that hold outside of the repository."""
    text = (HERE / "README.md").read_text(encoding="utf-8")
    text = re.sub(r"(!\[[^\]]*\]\()(?!\w+:)", rf"\1{URL}/raw/main/", text)
    return re.sub(r"\]\((?!\w+:|#)", f"]({URL}/blob/main/", text)


class BuildCompiled(build_py):
    """Copy the modules, then compile their loops, so that the first registration after an installation need not wait.

    Without the libraries that this takes, with GAPR_COMPILED=no, and on another processor, loops are compiled when they
    first run. A wheel with compiled loops is tagged with its Python and its platform.
    """

    def run(self):
        super().run()
        if self.editable_mode:
            return
        folder = Path(self.build_lib).resolve()
        for old in folder.rglob("*.nb[ic]"):
            old.unlink()  # of a build before: Numba does not see that a loop in another file has changed
        if os.environ.get("GAPR_COMPILED") == "no":
            return
        kept_there = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
        environment = kept_there | {
            "PYTHONPATH": os.pathsep.join([str(folder), *sys.path]),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        command = [sys.executable, "-m", "gapr_core.cli", "compile"]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
        asked = "bdist_wheel" in self.distribution.commands  # it may come after `build`
        wheel = self.distribution.get_command_obj("bdist_wheel", create=asked)
        if done.returncode or not list(folder.rglob("*.nbc")):
            why = done.stderr.strip().splitlines()[-1:]
            self.warn(f"the loops are not compiled, so the first registration takes half a minute: {why}")
        elif wheel is not None:
            wheel.python_tag = f"cp{sysconfig.get_config_var('py_version_nodot')}"
            wheel.plat_name, wheel.plat_name_supplied = sysconfig.get_platform(), True


setup(
    name=PACKAGE,
    version="0.2.0",
    description="Partial-to-full registration of bones with a calibrated confidence: library, command line, ROS 2 node",
    long_description=readme(),
    long_description_content_type="text/markdown",
    license="Apache-2.0",
    maintainer="GAPR maintainers",
    maintainer_email="maintainers@gapr.invalid",
    url=URL,
    project_urls={"Source": f"{URL}.git", "Issues": f"{URL}/issues", "Changelog": f"{URL}/blob/main/CHANGELOG.rst"},
    classifiers=[
        "Development Status :: 4 - Beta",
        "Intended Audience :: Healthcare Industry",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        *(f"Programming Language :: Python :: 3.{minor}" for minor in range(10, 14)),
        "Topic :: Scientific/Engineering :: Medical Science Apps.",
        "Typing :: Typed",
    ],
    python_requires=">=3.10,<3.14",
    packages=find_packages(include=["gapr_core*", "msg_adapters*", "gapr_ros*"]),
    cmdclass={"build_py": BuildCompiled},
    package_data={
        "gapr_core": ["weights/*.safetensors", "weights/*.json", "weights/*.md", "pages/templates/*", "py.typed"]
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        files("config", "*.yaml"),
        files("config/model", "*.yaml"),
        files("launch", "*.launch.py"),
        files("rviz", "*.rviz"),
        files("deploy", "*"),
        files("examples/ros", "*.py", "*.yaml"),
    ],
    install_requires=CORE,
    extras_require={
        "network": NETWORK,
        "data": DATA,
        "reports": [*REPORTS, *DATA],
        "training": [*NETWORK, *DATA, *REPORTS],
        "bags": BAGS,
        "cluster": CLUSTER,
        "medical": MEDICAL,
        "rerun": RERUN,
        "ros": [*ROS_WHEELS, *BAGS, *NETWORK, *DATA, *REPORTS],
        "baselines": BASELINES,
        "test": TEST,
        "docs": DOCS,
        "dev": [*TEST, *DOCS, "cosmic-ray", "mypy", "pre-commit", "types-PyYAML"],
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "gapr = gapr_core.__main__:main",
            "register_node = gapr_ros.register_node:main",
            "bag_replay = gapr_ros.bags.replay:main",
        ],
        "gapr.commands": ["demo = gapr_ros.demo.cli"],
        "gapr.sources": [  # the ending of a file, or a file that its folder has
            "mcap = gapr_ros.bags.source",
            "db3 = gapr_ros.bags.source",
            "metadata.yaml = gapr_ros.bags.source",
        ],
    },
)
