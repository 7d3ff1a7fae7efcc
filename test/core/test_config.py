"""Settings: one place for default, range and help; the same from a file, the command line and Python."""

import re
from dataclasses import dataclass, fields, is_dataclass

import numpy as np
import pytest

from gapr_core.config import ClutterConfig, RefinementConfig, RegistrarConfig, SensorConfig, VerificationConfig
from gapr_core.errors import ConfigError
from gapr_core.runtime import settings
from gapr_core.runtime.settings import Settings, from_dict, setting


def test_a_written_configuration_reads_back_the_same():
    config = RegistrarConfig(num_threads=4)
    assert RegistrarConfig.from_dict(config.to_dict()) == config


def test_what_is_not_named_keeps_its_default_and_lists_become_tuples():
    config = from_dict(
        RegistrarConfig,
        {"search": {"keep": 70}, "verification": {"coarse_limits_mm": [9.0, 4, 3]}, "min_confidence": 1},
    )
    assert config.search.keep == 70 and config.search.spins == RegistrarConfig().search.spins
    assert config.verification.coarse_limits_mm == (9.0, 4.0, 3)
    assert isinstance(config.min_confidence, float) and config.min_confidence == 1.0


@pytest.mark.parametrize(("said", "values"), [
    ("guide", {"guides": 1}), ("keep", {"search": {"keeps": 1}}),
    *[("of type", values) for values in (
        {"num_threads": "4"}, {"search": {"keep": 1.5}}, {"min_confidence": None}, {"guide": 1}, {"num_threads": True},
        {"verification": {"coarse_limits_mm": [9.0, 4.0]}}, {"clutter": {"radii_mm": 1.0}},
    )],
    *[("a mapping of settings", values) for values in (3, [1], {"search": 4})],
    *[("at least|to", values) for values in (
        {"min_confidence": 7.0}, {"min_confidence": -0.1}, {"min_confidence": float("nan")}, {"num_threads": -1},
        {"refinement": {"iterations": 0}}, {"clutter": {"radii_mm": [30.0, -1.0]}}, {"max_tre_mm": -1.0},
        {"other_bone_prior": 1.5}, {"sensor": {"noise_mm": -1.0}}, {"sensor": {"bias_mm": float("nan")}},
    )],
    ("one of unknown, pointer", {"sensor": {"kind": "sonar"}}),
    ("at least one of radii_mm", {"clutter": {"radii_mm": [], "seeds": []}}),
    ("as many seeds as radii_mm", {"clutter": {"radii_mm": [30.0]}}),
    ("smallest_sigma_mm that is not above", {"refinement": {"smallest_sigma_mm": 5.0, "largest_sigma_mm": 3.0}}),
])  # fmt: skip
def test_settings_that_cannot_be_are_refused(said, values):
    with pytest.raises(ConfigError, match=said):
        from_dict(RegistrarConfig, values)


def test_the_ends_of_a_range_are_inside():
    assert RegistrarConfig(min_confidence=1.0).min_confidence == 1.0
    assert ClutterConfig(radii_mm=(30.0,), seeds=(9,)).seeds == (9,)
    RefinementConfig(smallest_sigma_mm=3.0, largest_sigma_mm=3.0)


def test_settings_show_themselves_by_what_is_not_their_default():
    assert repr(RegistrarConfig(min_confidence=0.9)) == "RegistrarConfig(min_confidence=0.9)"
    assert repr(SensorConfig(kind="laser")) == "SensorConfig(kind=laser)"


@dataclass(frozen=True)
class Paint(Settings):
    colour: str = setting("red", "of the wall", choices=("red", "blue"))
    coats: dict[str, float] = setting({"first": 1.0}, "litres of each", low=0.0, unit="l")
    note: str | None = None


def test_choices_mappings_and_absent_values_are_checked_like_numbers():
    assert from_dict(Paint, {"colour": "blue", "coats": {"a": 2}, "note": None}) == Paint("blue", {"a": 2.0})
    with pytest.raises(ConfigError, match="one of red, blue"):
        Paint("green")
    with pytest.raises(ConfigError, match="at least 0 l"):
        Paint(coats={"a": -1.0})


def test_a_missing_value_without_a_default_is_named():
    @dataclass(frozen=True)
    class Point:
        x: float
        y: float = 0.0

    assert from_dict(Point, {"x": 1}) == Point(1.0)
    with pytest.raises(ConfigError, match="expected x for Point"):
        from_dict(Point, {"y": 1.0})


def test_a_file_and_assignments_over_it_make_the_settings(tmp_path):
    (tmp_path / "my.yaml").write_text("min_confidence: 0.7\nrefinement:\n  rounds: 5\n  iterations: 2\n")
    assigned = ["refinement.iterations=4", "refinement.rest_mm=1e-2", "clutter.radii_mm=[20.5, 40]"]
    config = settings.load(RegistrarConfig, tmp_path / "my.yaml", assigned)
    assert config.min_confidence == 0.7
    assert config.refinement == RefinementConfig(rounds=5, iterations=4, rest_mm=0.01)
    assert config.clutter.radii_mm == (20.5, 40.0)
    assert settings.load(RegistrarConfig) == RegistrarConfig()


@pytest.mark.parametrize(("assignment", "said"), [
    ("noise_mm=0.3", "did you mean sensor.noise_mm"), ("sensor.nois_mm=0.3", "did you mean sensor.noise_mm?"),
    ("min_confidense=0.3", "did you mean min_confidence?"), ("qqqqq=1", "correct it in RegistrarConfig"),
    *[(text, "expected ") for text in ("guide", "guide=1.5", "guide.x=1", "nothing=1", "guide=[", "search=3", "=1")],
])  # fmt: skip
def test_a_bad_assignment_is_answered_with_the_nearest_name(assignment, said):
    with pytest.raises(ConfigError, match=re.escape(said)):
        settings.load(RegistrarConfig, None, [assignment])


@pytest.mark.parametrize("content", [None, b"a: [", b"- 1", b"text", b"\xff\xfe\x00x", b"a: !!python/name:os.system x"])
def test_a_damaged_or_missing_file_is_one_sentence_that_names_it(tmp_path, content):
    if content is not None:
        (tmp_path / "my.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match="my.yaml") as caught:
        settings.load(RegistrarConfig, tmp_path / "my.yaml")
    assert "\n" not in str(caught.value)


def test_every_setting_has_a_help_and_every_number_a_range():
    def check(cls):
        for each in fields(cls):
            default = getattr(cls(), each.name)
            if is_dataclass(default):
                check(type(default))
                continue
            assert each.metadata.get("text"), f"{cls.__name__}.{each.name}"
            if not isinstance(default, bool | str):
                assert settings.range_text(each), f"{cls.__name__}.{each.name}"
            if each.name.endswith("_mm"):
                assert each.metadata["unit"] == "mm", f"{cls.__name__}.{each.name}"

    check(RegistrarConfig)


def test_the_table_of_settings_has_dotted_names_ranges_and_help():
    rows = {row.name: row for row in settings.table(RegistrarConfig)}
    assert rows["search.keep"].default == RegistrarConfig().search.keep
    assert rows["min_confidence"].range == "0 to 1" and rows["min_confidence"].text
    assert rows["verification.same_pose_mm"].range == "at least 0.1 mm"
    assert rows["verification.final_limits_mm"].default == VerificationConfig().final_limits_mm


@pytest.mark.parametrize("values", [
    {"sensor": "ultrasound"}, {"refinement": {"iterations": 5}}, {"num_threads": 1.5}, {"guide": "no"}, {"guide": 1},
    {"num_threads": "4"}, {"num_threads": True}, {"min_confidence": None}, {"num_threads": np.float64(1.5)},
])  # fmt: skip
def test_values_are_checked_in_python_as_well(values):
    with pytest.raises(ConfigError, match=f"{next(iter(values))} of type"):
        RegistrarConfig(**values)
    with pytest.raises(ConfigError, match="min_confidence of 0 to 1"):
        RegistrarConfig(min_confidence=7)


def test_numbers_of_numpy_are_numbers():
    kinds = {"num_threads": np.uint8(1), "guide": np.True_, "min_confidence": np.float32(0.5)}
    config = RegistrarConfig(**kinds, max_tre_mm=np.array(2))
    assert config == RegistrarConfig(num_threads=1, guide=True, min_confidence=0.5, max_tre_mm=2.0)
    kinds = [type(getattr(config, name)) for name in (*kinds, "max_tre_mm")]
    assert kinds == [int, bool, float, float]
    assert RegistrarConfig(num_threads=np.int64(3)).num_threads == 3
    assert from_dict(RegistrarConfig, {"num_threads": np.int32(3)}).num_threads == 3


@pytest.mark.parametrize(("text", "said"), [
    ("num_threads: 1\nguide: true\nnum_threads: 2\n", "num_threads again in line 3"),
    ("search:\n  keep: 7\n  keep: 8\n", "keep again in line 3"),
    ("search: {spins: 3}\nguide: true\nsearch: {keep: 7}\n", "search again in line 3"),
    ("a:\n- b: 1\n  b: 2\n", "b again in line 3"),
])  # fmt: skip
def test_a_key_that_stands_twice_in_a_file_is_refused(tmp_path, text, said):
    (tmp_path / "my.yaml").write_text(text)
    with pytest.raises(ConfigError, match=f"every key once in .*my.yaml; got {said}"):
        settings.load(RegistrarConfig, tmp_path / "my.yaml")


def test_a_key_may_stand_in_several_mappings_and_an_alias_be_used_again(tmp_path):
    (tmp_path / "my.yaml").write_text("a: &x {one: 1}\nb: *x\nc: {one: 2}\nd: [&y [*x], *y]\n")
    assert settings.read_yaml(tmp_path / "my.yaml")["b"] == {"one": 1}


BOMBS = {
    "aliases": "a: &a [1, 1, 1, 1, 1, 1, 1, 1]\n"
    + "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 8)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
    "brackets": "a: " + "[" * 20_000,
    "itself": "a: &a [*a, *a]\n",
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_a_yaml_that_unfolds_without_end_is_refused_at_once(tmp_path, bomb):
    (tmp_path / "a.yaml").write_text(BOMBS[bomb])
    with pytest.raises(ConfigError, match="nested too deeply|aliases stand for"):
        RegistrarConfig.from_yaml(tmp_path / "a.yaml")
    with pytest.raises(ConfigError, match="value"):
        settings.load(RegistrarConfig, None, [f"search.spins={BOMBS[bomb].removeprefix('a: ')}"])
