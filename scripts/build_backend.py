"""setuptools, with what a wheel's loops are compiled with; an editable installation needs none of it."""

from setuptools import build_meta
from setuptools.build_meta import *  # noqa: F403


def get_requires_for_build_wheel(config_settings=None):
    """What setuptools asks for, and what the package itself needs to register a cloud."""
    from distutils.core import run_setup  # setuptools' own, which it puts there

    usual = build_meta.get_requires_for_build_wheel(config_settings)
    return [*usual, *run_setup("setup.py", stop_after="init").install_requires]
