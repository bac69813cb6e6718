"""How recordings are prepared for a fit; read without tensors."""

from dataclasses import dataclass

from lidarpainter_models.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class ObservationConfig:
    """How recordings are prepared for a fit."""

    width_px: int = 480
    """Fit width; the height keeps each camera's aspect ratio. Narrower recordings keep theirs."""
    registers_sweeps: bool = True
    """Find where the car drove by laying its LiDAR sweeps onto one another: recorded poses lack how
    it pitches and rolls."""
    corrects_cameras: bool = False
    """Find late, turned and slowly read cameras and correct them before the fit. Off: on a real log
    without such faults it believed in a readout and cost the held-out views 0.4 dB."""

    def __post_init__(self) -> None:
        """Refuse images too small for the SSIM window."""
        if self.width_px < 32:
            raise ConfigError(f"width_px must be at least 32, got {self.width_px}")
