"""Which looks of a camera are kept, and what becomes of those that do not fit the others."""

from dataclasses import replace

import numpy as np
import pytest
import tiny

from gapr_core import ConfigError, InvalidPointCloudError, LookAccumulator, Registrar, Tracker
from gapr_core.geometry import se3
from gapr_core.registration.scenes.scene import Look
from gapr_core.registration.streams.look_accumulator import STUCK
from gapr_core.results import Effect, LookAnswer, LookFit, RegistrationResult, RegistrationStatus

OK = RegistrationResult(RegistrationStatus.OK, np.eye(4))
REFUSED = RegistrationResult(RegistrationStatus.LOW_CONFIDENCE, reason="too little bone")
MOVED = RegistrationResult(RegistrationStatus.OK, se3.exp([9.0, 0.0, 0.0, 0.0, 0.0, 0.0]))


@pytest.fixture(scope="module")
def target():
    return tiny.ellipsoid()


class Asked:
    """Stands for `Registrar.register`: gives the answers in turn, the last one again and again; keeps what it gets."""

    def __init__(self, *answers):
        self.answers, self.sources, self.places = list(answers), [], []
        self.initial, self.alone = [], OK  # `alone`: what a single look says

    def __call__(self, source, target, initial, viewpoint):
        if not isinstance(viewpoint, list):  # of looks
            return self.alone
        self.initial.append(initial)
        self.sources.append(source)
        self.places.append([look.viewpoint.tolist() for look in viewpoint])
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Exception):
            raise answer
        return answer(viewpoint) if callable(answer) else answer


def looks_of(answer, *more, **how):
    method = Registrar()
    method.register = Asked(answer, *more)
    return LookAccumulator(method, **how), method.register


def points(name):
    """Six points about the origin whose z says which look they are of."""
    angles = np.arange(6.0)
    return np.column_stack([np.cos(angles), np.sin(angles), np.full(6, 0.01 * name)])


def eye(deg):
    return 400.0 * np.array([np.sin(np.radians(deg)), 0.0, np.cos(np.radians(deg))])


def names(collected):
    return [round(100.0 * z) for z in np.asarray(collected)[::6, 2]]


def saying(answer, fit, *numbers):
    """An answer in which the looks of these numbers, the oldest 0, fit so, and the others do."""

    def said(looks):
        fits = np.full(len(looks), LookFit.FITS, dtype=object)
        fits[list(numbers)] = fit
        return replace(answer, looks=tuple(map(LookAnswer, [look.viewpoint for look in looks], fits)))

    return said


def apart(*numbers):
    """A refusal, since the looks of these numbers show the bone elsewhere."""
    refused = replace(REFUSED, status=RegistrationStatus.AMBIGUOUS, reason="elsewhere")
    return saying(refused, LookFit.APART, *numbers)


def blind(*numbers):
    """A pose that is accepted although the looks of these numbers show nothing of the bone."""
    return saying(OK, LookFit.BLIND, *numbers)


def test_each_look_is_registered_with_those_before_it_and_keeps_its_place(target):
    looks, asked = looks_of(OK)
    assert looks.register(points(1), target, viewpoint=eye(0.0)).method == "gapr_looks"
    looks.register(points(2), target, viewpoint=eye(20.0))
    assert names(asked.sources[0]) == [1] and names(asked.sources[1]) == [1, 2]
    assert asked.places[1] == [eye(0.0).tolist(), eye(20.0).tolist()]


def test_the_oldest_goes_beyond_most(target):
    looks, asked = looks_of(OK, most=2)
    for number in range(4):
        looks.register(points(number), target, viewpoint=eye(20.0 * number))
    assert names(asked.sources[-1]) == [2, 3] == names(looks.collected)
    assert names(looks.together_with(points(9), eye(80.0))) == [3, 9]
    assert names(looks.together_with(points(9), eye(61.0))) == [2, 9]
    assert names(looks.together_with(points(9)[:5], eye(80.0))) == [2, 3]


DOUBTFUL = replace(REFUSED, status=RegistrationStatus.AMBIGUOUS)
KEPT = {  # answers in turn, directions of the looks, which are kept, and whether the last is accepted
    "of one direction the newest": ([OK], (0.0, 40.0, 7.9), [1, 2], True),
    "another direction": ([OK], (0.0, 40.0, 8.1), [0, 1, 2], True),
    "a camera that rests": ([OK], (0.0, 5.0, 7.0, 3.0, 7.5), [4], True),
    "a camera that rests elsewhere": ([OK], (0.0, *[30.0] * (STUCK + 4)), [0, STUCK + 4], True),
    "a new direction after refusals": ([REFUSED], (*[0.0] * STUCK, 30.0, 30.0), [STUCK - 1, STUCK + 1], False),
    "a pose ends the row": ([OK, OK, apart(-1), apart(-1), OK, apart(-1)], range(0, 90, 15), [0, 1, 4], False),
    "an older look shows nothing": ([OK, OK, blind(0)], (0.0, 20.0, 40.0), [0, 1, 2], True),
    "older ones that did not fit, and a refusal": ([OK, OK, apart(0), REFUSED], (0.0, 20.0, 40.0), [0, 1, 2], False),
    "looks that show nothing are no row": (
        [OK, *[saying(DOUBTFUL, LookFit.BLIND, -1)] * 5], range(0, 100, 20), [0], False),
    "a refusal does not say that a look shows nothing": (
        [OK, saying(REFUSED, LookFit.BLIND, -1)], (0.0, 20.0), [0, 1], False),
    "a look that is too small": ([OK, saying(REFUSED, LookFit.TOO_SMALL, -1)], (0.0, 20.0), [0], False),
    "a doubtful pose does": ([OK, saying(DOUBTFUL, LookFit.BLIND, -1)], (0.0, 20.0), [0], False),
    "an older one shows nothing": ([OK, saying(REFUSED, LookFit.BLIND, 0)], (0.0, 20.0), [0, 1], False),
}  # fmt: skip


@pytest.mark.parametrize("case", KEPT)
def test_looks_that_are_kept(target, case):
    answers, degrees, kept, is_accepted = KEPT[case]
    looks, _ = looks_of(*answers)
    for number, deg in enumerate(degrees):
        result = looks.register(points(number), target, viewpoint=eye(deg))
    assert names(looks.collected) == kept and result.ok is is_accepted
    assert "restart" not in result.reason or case == "a new direction after refusals"


@pytest.mark.parametrize("step", [1.0, 3.0, 7.0])
def test_of_a_camera_that_moves_on_slowly_some_looks_stay(target, step):
    looks, _ = looks_of(OK)
    for number in range(int(57.0 / step)):
        looks.register(points(number), target, viewpoint=eye(step * number))
    at = step * np.array(names(looks.collected))
    assert len(at) == 4 and at[-1] == step * (int(57.0 / step) - 1), "the newest is among them"
    assert at[-1] - at[0] >= 16.0


@pytest.mark.parametrize(("mm", "confidence", "alone", "is_refused"), [
    (3.9, 0.8, "same", False), (4.1, 0.8, "same", True), (9.0, 0.94, "same", True), (9.0, 0.95, "same", False),
    (9.0, 0.99, "none", True), (3.9, 0.99, "none", False),
])  # fmt: skip
def test_a_pose_that_is_not_sure_and_another_than_the_last_is_refused(target, mm, confidence, alone, is_refused):
    """The bone rests in the frame of the looks: poses at .5 and .8 lay 460 mm from right ones before them."""
    moved = replace(OK, confidence=confidence, T_target_source=se3.exp([mm, 0.0, 0.0, 0.0, 0.0, 0.0]))
    looks, asked = looks_of(replace(OK, confidence=0.7), moved)
    assert looks.register(points(0), target, viewpoint=eye(0.0)).ok
    asked.alone = moved if alone == "same" else REFUSED
    result = looks.register(points(1), target, viewpoint=eye(20.0))
    assert result.ok is not is_refused and names(looks.collected) == ([0] if is_refused else [0, 1])
    if is_refused:
        assert result.status is RegistrationStatus.AMBIGUOUS and "another one than the last" in result.reason


def test_the_third_pose_in_a_row_that_is_another_than_the_last_restarts_the_collection(target):
    moved = replace(MOVED, confidence=0.8)
    looks, asked = looks_of(replace(OK, confidence=0.8), moved)
    looks.register(points(0), target, viewpoint=eye(0.0))
    asked.alone = moved
    results = [looks.register(points(number), target, viewpoint=eye(20.0 * number)) for number in range(1, 5)]
    assert [result.ok for result in results] == [False, False, False, True]
    assert "3 in a row" in results[2].reason and names(looks.collected) == [1, 2, 3, 4]


WRONG = replace(MOVED, confidence=0.8)
RIGHT = replace(OK, confidence=0.8)


@pytest.mark.parametrize(("answers", "accepted"), [
    ([RIGHT, RIGHT, WRONG, RIGHT, RIGHT], [1, 1, 0, 1, 1]),
    ([WRONG, RIGHT, RIGHT, RIGHT, RIGHT], [1, 0, 0, 0, 1]),
    ([RIGHT, WRONG, WRONG, RIGHT, WRONG, WRONG, WRONG], [1, 0, 0, 1, 0, 0, 0]),
])  # fmt: skip
def test_a_pose_that_contradicts_the_last_is_no_doubt_of_what_comes(target, answers, accepted):
    looks, asked = looks_of(*answers)
    asked.alone = REFUSED
    found = [looks.register(points(n), target, viewpoint=eye(20.0 * n)).ok for n in range(len(answers))]
    assert found == [bool(is_right) for is_right in accepted]


def test_each_by_itself_is_not_compared_with_the_last(target):
    looks, _ = looks_of(RIGHT, WRONG, most=1)
    assert all(looks.register(points(n), target, viewpoint=eye(20.0 * n)).ok for n in range(2))


@pytest.mark.parametrize(("deg", "is_confirmed"), [(0.2, False), (7.9, False), (8.1, True)])
def test_a_look_confirms_nothing_that_was_taken_from_where_the_newest_was(target, deg, is_confirmed):
    sure, moved = (replace(each, confidence=0.99) for each in (OK, MOVED))
    looks, asked = looks_of(sure, sure, moved)
    looks.register(points(0), target, viewpoint=eye(0.0))
    looks.register(points(1), target, viewpoint=eye(7.9))
    asked.alone = moved
    last = looks.register(points(2), target, viewpoint=eye(7.9 + deg))
    assert last.ok is is_confirmed and names(asked.sources[-1]) == [1, 2]


def test_a_camera_that_sways_keeps_two_looks(target):
    looks, _ = looks_of(OK)
    kept = []
    for number, deg in enumerate((0.0, 6.0, 12.0, 6.0, 0.0, 6.0, 12.0)):
        looks.register(points(number), target, viewpoint=eye(deg))
        kept.append(len(looks.collected) // 6)
    assert kept == [1, 1, 2, 2, 2, 2, 2]


@pytest.mark.parametrize(("camera_mm", "shown_mm", "kept"), [
    (100.0, 100.0, 2), (50.0, 50.0, 1), (0.0, 100.0, 2), (0.0, 50.0, 1), (100.0, 0.0, 2), (50.0, 0.0, 1),
])  # fmt: skip
def test_looks_differ_by_where_the_camera_is_and_by_what_it_shows(camera_mm, shown_mm, kept):
    """From 400 mm away, 56 mm are 8 deg."""
    looks, _ = looks_of(OK)
    looks.collect(points(1), eye(0.0))
    looks.collect(points(2) + [shown_mm, 0.0, 0.0], eye(0.0) + [camera_mm, 0.0, 0.0])
    assert len(looks.collected) == 6 * kept


def test_a_camera_in_the_middle_of_what_it_shows_is_no_error():
    looks, _ = looks_of(OK)
    looks.collect(points(1), points(1).mean(axis=0))
    looks.collect(points(1), points(1).mean(axis=0))
    assert len(looks.collected) == 12, "no direction is the same as another"


def test_two_looks_from_one_place_stay_two_where_all_are_kept(target):
    looks, asked = looks_of(OK, apart_deg=0.0)
    looks.register(points(1), target, viewpoint=eye(0.0))
    looks.register(points(2), target, viewpoint=eye(0.0))
    assert len(asked.places[-1]) == 2


def test_the_newest_that_does_not_fit_is_left_out_and_three_in_a_row_are_all_that_is_kept(target):
    looks, asked = looks_of(OK, OK, apart(-1), apart(-1), apart(-1), OK)
    for number in range(2):
        looks.register(points(number), target, viewpoint=eye(20.0 * number))
    for number, at in ((2, 40.0), (3, 1.0), (4, 60.0)):
        result = looks.register(points(number), target, viewpoint=eye(at))
        assert not result.ok and result.reason.startswith("elsewhere; ")
        if number < 4:
            assert "left out" in result.reason and names(looks.collected) == [0, 1]
    assert "3 in a row" in result.reason and names(looks.collected) == [2, 3, 4]
    looks.register(points(5), target, viewpoint=eye(80.0))
    assert names(asked.sources[-1]) == [2, 3, 4, 5]


@pytest.mark.parametrize("deg", [1.0, 60.0])
def test_a_newest_look_that_shows_nothing_of_the_bone_is_refused_and_left_out(target, deg):
    """However often: a hand before the camera says nothing of the bone. After ten in a row that one alone is kept."""
    looks, asked = looks_of(OK, OK, blind(-1))
    for number in range(2):
        looks.register(points(number), target, viewpoint=eye(20.0 * number))
    for number in range(STUCK):
        result = looks.register(points(2 + number), target, viewpoint=eye(deg))
        assert result.status is RegistrationStatus.AMBIGUOUS and result.T_target_source is None
        assert "newest look shows nothing" in result.reason
        assert names(looks.collected) == ([0, 1] if number < STUCK - 1 else [2 + number])
    assert "restarts with the last look" in result.reason


@pytest.mark.parametrize(("x_mm", "deg", "is_refused"), [
    (3.9, 0.0, False), (4.1, 0.0, True), (0.0, 4.9, False), (0.0, 5.1, True),
])  # fmt: skip
def test_a_newest_look_that_alone_has_another_pose_is_refused(target, x_mm, deg, is_refused):
    looks, asked = looks_of(OK)
    looks.register(points(0), target, viewpoint=eye(0.0))
    centre = points(1).mean(axis=0)
    asked.alone = replace(OK, T_target_source=se3.exp([x_mm, 0.0, 0.0, 0.0, 0.0, np.radians(deg)], centre))
    result = looks.register(points(1), target, viewpoint=eye(20.0))
    assert result.ok is not is_refused and names(looks.collected) == ([0] if is_refused else [0, 1])
    if is_refused:
        assert "newest look alone has another pose" in result.reason
        assert [(each.check, each.effect) for each in result.findings] == [("newest look", Effect.REFUSE)]


def test_a_first_look_is_not_compared_with_itself(target):
    looks, asked = looks_of(OK)
    asked.alone = replace(OK, T_target_source=se3.exp([9.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert looks.register(points(0), target, viewpoint=eye(0.0)).ok


def test_older_looks_that_do_not_fit_are_left_out_and_the_others_asked_again(target):
    looks, asked = looks_of(OK, OK, apart(0), OK)
    for number in range(3):
        result = looks.register(points(number), target, viewpoint=eye(20.0 * number))
    assert [names(each) for each in asked.sources] == [[0], [0, 1], [0, 1, 2], [1, 2]]
    assert result.ok and names(looks.collected) == [1, 2]


@pytest.mark.parametrize(("count", "off"), [(4, (0, 1, 2)), (4, (0, 1)), (3, (0, 1)), (2, (0,))])
def test_one_look_does_not_overrule_as_many_others(target, count, off):
    """A tracker may err for one of them. The third in a row is believed, as ever."""
    looks, asked = looks_of(*[OK] * (count - 1), apart(*off))
    for number in range(count):
        result = looks.register(points(number), target, viewpoint=eye(20.0 * number))
    assert not result.ok and result.reason == "elsewhere; left out" and len(asked.sources) == count
    assert names(looks.collected) == list(range(count - 1))


def test_after_looks_that_show_the_bone_elsewhere_one_that_says_nothing_is_refused(target):
    """It does not show that the bone is where it was, and does not end the row."""
    looks, asked = looks_of(OK)
    for number, alone in enumerate((OK, MOVED, REFUSED, MOVED, MOVED)):
        asked.alone = alone
        result = looks.register(points(number), target, viewpoint=eye(20.0 * number))
        assert result.ok is (number == 0)
        if number == 2:
            assert result.status is RegistrationStatus.AMBIGUOUS and "alone gives no pose" in result.reason
            assert names(looks.collected) == [0]
    assert "3 in a row" in result.reason and names(looks.collected) == [1, 3, 4]


def test_a_refusal_does_not_end_the_row_of_looks_that_show_the_bone_elsewhere(target):
    looks, asked = looks_of(OK, OK, REFUSED, OK)
    for number, alone in enumerate((OK, MOVED, OK, REFUSED)):
        asked.alone = alone
        result = looks.register(points(number), target, viewpoint=eye(20.0 * number))
    assert result.status is RegistrationStatus.AMBIGUOUS and "alone gives no pose" in result.reason


def test_the_times_of_all_that_was_asked_add_up(target):
    first = apart(0)([Look(points(0), eye(0.0))] * 3)
    answers = replace(first, stage_ms={"verify": 5.0}), replace(OK, stage_ms={"verify": 2.0, "refine": 1.0})
    looks, _ = looks_of(*answers)
    for number in (0, 1):
        looks.collect(points(number), eye(20.0 * number))
    result = looks.register(points(2), target, viewpoint=eye(40.0))
    assert result.stage_ms["verify"] == 7.0 and result.stage_ms["refine"] == 1.0 and "compare" in result.stage_ms


def test_looks_metres_away_are_left_out_and_the_third_restarts_the_collection(target):
    looks, _ = looks_of(OK)
    looks.register(points(0), target, viewpoint=eye(0.0))
    away = [4000.0, 0.0, 0.0]
    for number in (1, 2):
        with pytest.raises(InvalidPointCloudError, match="near the others"):
            looks.register(points(number) + away, target, viewpoint=eye(20.0) + away)
        assert names(looks.collected) == [0]
    looks.register(points(3) + away, target, viewpoint=eye(20.0) + away)
    assert names(looks.collected) == [3]
    with pytest.raises(InvalidPointCloudError, match="the look"):
        looks.collect(np.concatenate([points(4), points(4) + away]), eye(40.0))


def test_after_ten_refusals_from_one_direction_the_last_look_alone_is_kept(target):
    looks, _ = looks_of(REFUSED)
    looks.register(points(0), target, viewpoint=eye(0.0))
    for number in range(1, STUCK + 1):
        result = looks.register(points(number), target, viewpoint=eye(30.0))
        assert names(looks.collected) == ([0, number] if number < STUCK else [number])
    assert "restarts with the last look" in result.reason


def test_poses_end_the_count_of_refusals(target):
    looks, _ = looks_of(OK, *[REFUSED] * (STUCK - 1), OK, REFUSED, REFUSED)
    for number in range(STUCK + 2):
        looks.register(points(number), target, viewpoint=eye(30.0 * (number > 0)))
        assert names(looks.collected) == ([0, number] if number else [0])


@pytest.mark.parametrize("error", [InvalidPointCloudError("a", "b", "c"), RuntimeError("d")])
def test_looks_that_cannot_be_registered_are_not_kept_however_many(target, error):
    looks, _ = looks_of(OK, error, error, error, error, OK)
    looks.register(points(0), target, viewpoint=eye(0.0))
    for number in range(1, 5):
        with pytest.raises(type(error)):
            looks.register(points(number), target, viewpoint=eye(20.0))
        assert names(looks.collected) == [0]


def test_a_first_guess_goes_to_the_method(target):
    looks, asked = looks_of(OK)
    guess = se3.exp([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    looks.register(points(0), target, guess, eye(0.0))
    assert asked.initial == [guess]


def test_another_target_begins_a_new_collection(target):
    looks, asked = looks_of(OK)
    looks.register(points(1), target, viewpoint=eye(0.0))
    looks.register(points(2), replace(target), viewpoint=eye(20.0))
    assert names(asked.sources[-1]) == [2]


def test_an_empty_look_is_refused_and_changes_nothing(target):
    looks, asked = looks_of(OK)
    looks.register(points(1), target, viewpoint=eye(0.0))
    result = looks.register(np.full((3, 3), np.nan), target, viewpoint=eye(20.0))
    assert result.status is RegistrationStatus.TOO_FEW_POINTS and len(asked.sources) == 1
    looks.collect(np.empty((0, 3)), eye(20.0))
    assert names(looks.collected) == [1]


def test_a_look_needs_its_place(target):
    looks, _ = looks_of(OK)
    with pytest.raises(ConfigError, match="where the camera was"):
        looks.register(points(1), target)
    with pytest.raises(InvalidPointCloudError, match="viewpoint"):
        looks.collect(points(1), np.zeros((3, 3)))


@pytest.mark.parametrize("how", [
    {"most": 0}, {"most": 17}, {"most": 2.5}, {"apart_deg": -1.0}, {"apart_deg": np.nan}, {"method": object()},
])  # fmt: skip
def test_settings_that_are_none_are_refused(how):
    with pytest.raises(ConfigError, match="a Registrar or a Tracker" if "method" in how else "expected"):
        LookAccumulator(**{"method": Registrar()} | how)


def test_a_tracker_is_one_of_its_own_whose_sources_count_as_one():
    tracker = Tracker(Registrar())
    looks = LookAccumulator(tracker)
    assert looks.method is not tracker
    looks.method._has_track = True
    looks.reset()
    assert not looks.method._has_track


@pytest.mark.parametrize(("count", "is_kept"), [(5, False), (6, True)])
def test_a_look_of_fewer_points_than_a_pose_needs_changes_nothing(target, count, is_kept):
    looks, asked = looks_of(OK)
    looks.register(points(0), target, viewpoint=eye(0.0))
    looks.collect(points(1)[:count], eye(1.0))
    assert names(looks.collected) == [1 if is_kept else 0]
    result = looks.register(points(2)[:count], target, viewpoint=eye(2.0))
    assert names(looks.collected) == [2 if is_kept else 0] and result.ok is is_kept
    assert is_kept or (result.status is RegistrationStatus.TOO_FEW_POINTS and "5 finite points" in result.reason)


@pytest.mark.parametrize("bad", [{"viewpoint": None}, {"viewpoint": [1.0]}])
def test_what_is_no_look_forgets_nothing(target, bad):
    looks, _ = looks_of(OK)
    looks.register(points(0), target, viewpoint=eye(0.0))
    with pytest.raises((ConfigError, InvalidPointCloudError)):
        looks.register(points(1), replace(target), **bad)
    assert names(looks.collected) == [0]


@pytest.mark.parametrize("answer", [apart(-1), REFUSED])
def test_a_collection_that_restarts_forgets_the_track(target, answer, monkeypatch):
    tracker = Tracker(Registrar())
    looks = LookAccumulator(tracker)
    monkeypatch.setattr(looks.method, "register", Asked(REFUSED, answer))
    looks.register(points(0), target, viewpoint=eye(0.0))
    for number in range(1, STUCK + 1):
        looks.method._has_track = True
        result = looks.register(points(number), target, viewpoint=eye(30.0))
        if "restarts" in result.reason:
            break
    assert "restarts" in result.reason and not looks.method._has_track
