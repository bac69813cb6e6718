"""The names that `__getattr__` finds, for type checkers and editors."""

from lidarpainter_models.api import ConditionBuilder as ConditionBuilder
from lidarpainter_models.api import FitConfig as FitConfig
from lidarpainter_models.api import ObservationConfig as ObservationConfig
from lidarpainter_models.api import Shift as Shift
from lidarpainter_models.api import SyntheticStreetConfig as SyntheticStreetConfig
from lidarpainter_models.api import camera_beside as camera_beside
from lidarpainter_models.api import evaluate as evaluate
from lidarpainter_models.api import fit_gaussians as fit_gaussians
from lidarpainter_models.api import load_painter as load_painter
from lidarpainter_models.api import open_scene as open_scene
from lidarpainter_models.api import prepare_observations as prepare_observations
from lidarpainter_models.api import split_views as split_views
from lidarpainter_models.api import write_png as write_png
from lidarpainter_models.api import write_street as write_street

__version__: str
