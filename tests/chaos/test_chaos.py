"""Whatever is killed, restarted or filled: afterwards everything is there, once."""

import pytest
import run_chaos
from production_services import NO_POSTGRES


@pytest.mark.slow
@pytest.mark.skipif(NO_POSTGRES is not None, reason=str(NO_POSTGRES))
def test_a_fleet_survives_its_kills():
    """Thirty kills of a hundred sequences, for an hour: `python tests/chaos/run_chaos.py`."""
    found = run_chaos.run_chaos(sequences=24, corrupted=3, kills=10, seed=0, pace_s=1.0)
    assert found["wrong"] == []
