import pytest

from gapr_core.config import RegistrarConfig, as_dict, flatten, from_dict
from gapr_core.errors import ConfigError


def test_a_written_configuration_reads_back_the_same():
    config = RegistrarConfig(seed=4)
    assert from_dict(RegistrarConfig, as_dict(config)) == config


def test_what_is_not_named_keeps_its_default_and_lists_become_tuples():
    config = from_dict(
        RegistrarConfig,
        {"search": {"keep": 7}, "verification": {"coarse_limits_mm": [9.0, 4.0, 3]}, "min_confidence": 1},
    )
    assert config.search.keep == 7 and config.search.spins == RegistrarConfig().search.spins
    assert config.verification.coarse_limits_mm == (9.0, 4.0, 3)
    assert config.min_confidence == 1.0


@pytest.mark.parametrize("values", [{"seeds": 1}, {"search": {"keeps": 1}}])
def test_a_name_that_does_not_exist_is_refused_with_those_that_do(values):
    with pytest.raises(ConfigError, match="keep|seed"):
        from_dict(RegistrarConfig, values)


@pytest.mark.parametrize("values", [{"seed": "4"}, {"search": {"keep": 1.5}}, {"min_confidence": None}])
def test_a_value_of_another_kind_is_refused(values):
    with pytest.raises(ConfigError, match="of type"):
        from_dict(RegistrarConfig, values)


def test_flat_names_have_dots():
    assert flatten(RegistrarConfig())["search.keep"] == RegistrarConfig().search.keep
