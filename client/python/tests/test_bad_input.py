"""What is wrong with a request is told by a typed error that names the field."""

import threading

import numpy as np
import pytest

import gatsbi_client as gc
from gatsbi_client import costs

TARGET = costs.program(costs.to_target("all_objects", 0.0, 0.0))


@pytest.fixture(scope="module")
def session(address, frames):
    with gc.Client(address) as client, client.create_session() as session:
        session.observe(frames[0])
        yield session


def refused(call, kind=gc.InvalidRequest):
    with pytest.raises(kind) as e:
        call()
    return e.value


def test_an_object_that_there_is_not(session, dimension):
    program = costs.program(costs.action_magnitude(), costs.to_target(10**6, 0, 0))
    for call in (
        lambda: session.score(np.zeros((1, 2, dimension)), program), lambda: session.plan(2, program),
    ):
        (field,) = refused(call).fields
        assert field.field.startswith("costs.terms[1]") and str(10**6) in field.description


def test_a_low_bound_above_the_high_one(session, dimension):
    low, high = [-0.1] * dimension, [0.1] * dimension
    low[2] = 0.2
    error = refused(lambda: session.plan(2, TARGET, action_min=low, action_max=high))
    assert error.fields[0].field == "action_max[2]" and "action_min[2], 0.2" in error.fields[0].description
    error = refused(lambda: session.plan(2, TARGET, action_min=low[:-1], action_max=high))
    assert "action_min" in error.fields[0].field


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_goals_that_are_no_numbers(session, client, frames, value):
    error = refused(lambda: session.plan(2, costs.program(costs.to_target("all_objects", value, 0.0))))
    assert error.fields[0].field.startswith("costs.terms[0].to_target.target")
    image = frames[0].astype(np.float32) / 255
    image[3, 4, 1] = value
    assert refused(lambda: client.put_goal(image)).fields[0].field.startswith("image")
    masks = {"all_objects": np.full(frames[0].shape[:2], value, dtype=np.float32)}
    assert refused(lambda: client.put_goal(masks=masks)).fields[0].field.startswith("masks[0]")


def test_goal_pictures_of_a_wrong_shape(client, frames):
    side = frames.shape[1]

    def masks(shape, part="agent", ids=()):
        error = refused(lambda: client.put_goal(masks={part: np.zeros(shape, np.float32)}, object_ids=ids))
        return error.fields[0].field

    assert masks((side, side, 3)) == masks((side,)) == masks((side, side), "each_object") == "masks[0].masks.shape"
    assert masks((2, side, side), "each_object", [7]) == "masks[0].object_ids"
    for image in (frames[0][..., :2], frames[0][..., 0], frames[0][:0]):
        assert refused(lambda: client.put_goal(image)).fields[0].field.startswith("image")
    refused(lambda: client.put_goal(b"no picture"))
    refused(lambda: client.put_goal())
    # Another height and width is no mistake: goals are fitted as frames are.
    client.delete_goal(client.put_goal(frames[0][::2, ::4]).id)


def test_more_candidates_than_the_limits_allow(session, client, dimension):
    most = client.models()[0].max_candidates
    error = refused(lambda: session.score(np.zeros((most + 1, 1, dimension), dtype=np.float32), TARGET))
    assert error.fields[0].field.startswith("actions") and str(most) in error.fields[0].description
    error = refused(lambda: session.plan(2, TARGET, optimiser=gc.RandomShooting(candidates=most + 1)))
    assert "candidates" in error.fields[0].field


def test_a_budget_too_short_for_one_iteration(session):
    error = refused(
        lambda: session.plan(15, TARGET, optimiser=gc.Cem(candidates=256), budget=0.002), gc.DeadlineExceeded
    )
    assert error.reason


def test_a_session_deleted_in_the_middle_of_a_plan(client, frames):
    session = client.create_session()
    session.observe(frames[0])
    failed = []

    def plan():
        try:
            session.plan(10, TARGET, optimiser=gc.Cem(candidates=64, iterations=100))
        except gc.GatsbiError as error:
            failed.append(error)

    planning = threading.Thread(target=plan)
    planning.start()
    # Its first iteration takes longer than a session takes to be asked for.
    session.refresh()
    session.delete()
    planning.join(60)
    assert not planning.is_alive() and isinstance(failed[0], gc.NotFound)
