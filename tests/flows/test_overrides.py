"""Single settings can be changed, and only those that exist, to what they may be."""

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from pydantic import BaseModel, ConfigDict

from flows.overrides import with_overrides
from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    shifts_m: tuple[float, ...] = (2.0,)
    limit: float | None = None

    def __post_init__(self):
        if self.limit is not None and self.limit <= 0:
            raise ConfigError(f"limit must be positive, got {self.limit}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Middle:
    steps: int = 10
    is_fast: bool = False
    inner: Inner = field(default_factory=Inner)


class Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    fit: Middle = Middle()
    name: str = "a"
    folder: Path | None = None


@pytest.mark.parametrize(
    ("assignment", "read"),
    [
        ("fit.steps=500", lambda model: model.fit.steps == 500),
        ("fit.is_fast=true", lambda model: model.fit.is_fast is True),
        ("fit.inner.shifts_m=2,3", lambda model: model.fit.inner.shifts_m == (2.0, 3.0)),
        ("fit.inner.shifts_m=[1.5]", lambda model: model.fit.inner.shifts_m == (1.5,)),
        ("fit.inner.shifts_m=4", lambda model: model.fit.inner.shifts_m == (4.0,)),
        ("fit.inner.limit=0.25", lambda model: model.fit.inner.limit == 0.25),
        ("fit.inner.limit=none", lambda model: model.fit.inner.limit is None),
        ("name=b=c", lambda model: model.name == "b=c"),
        ("folder=/a/b", lambda model: model.folder == Path("/a/b")),
    ],
)
def test_a_setting_is_changed_and_the_others_stay(assignment, read):
    changed = with_overrides(Model(), [assignment])
    assert read(changed)
    assert with_overrides(changed, []) == changed
    assert Model() == Model(fit=Middle(), name="a")


@pytest.mark.parametrize(
    ("assignment", "complaint"),
    [
        ("fit.step=5", r"no setting 'fit.step': fit has steps, is_fast, inner"),
        ("fits.steps=5", r"no setting 'fits.steps': the parameters have fit, name, folder"),
        ("fit.steps.more=5", r"no setting 'fit.steps.more': fit.steps has nothing to set"),
        ("fit.steps=many", r"fit.steps=many: .*integer"),
        ("fit.steps=1.5", r"fit.steps=1.5: .*integer"),
        ("fit.inner.limit=-1", r"limit must be positive"),
        ("fit.steps", r"expected a setting as key=value"),
        ("=5", r"expected a setting as key=value"),
    ],
)
def test_what_cannot_be_set_is_one_line(assignment, complaint):
    with pytest.raises(ConfigError, match=complaint) as caught:
        with_overrides(Model(), [assignment])
    assert "\n" not in str(caught.value)
