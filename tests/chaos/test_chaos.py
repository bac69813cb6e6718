"""Whatever is killed, restarted or filled: afterwards everything is there, once."""

import pytest
from production_services import NO_POSTGRES
from run_chaos import run_chaos


@pytest.mark.slow
@pytest.mark.skipif(NO_POSTGRES is not None, reason=str(NO_POSTGRES))
def test_a_fleet_survives_thirty_kills():
    found = run_chaos(sequences=100, corrupted=10, kills=30, seed=0, pace_s=2.0)
    assert found["wrong"] == []
