import pytest

from gatsbi_client import costs


@pytest.fixture
def session(client, frames):
    with client.create_session() as session:
        session.observe(frames[0])
        yield session


@pytest.fixture
def pushed(session, frames, dimension):
    return session.observe(frames[1], [0.0] * dimension).present()[0]


@pytest.fixture
def program(pushed):
    """Costs that tell candidates apart: an object's way, and what moving costs."""
    return costs.program(
        costs.to_target(pushed.id, pushed.x + 0.4, pushed.y), costs.action_magnitude(weight=0.05),
        constraints=[costs.at_most(costs.region("agent", -1, -1, 1, 1), 5.0)],
    )
