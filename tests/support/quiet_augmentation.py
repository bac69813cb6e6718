"""An augmentation that cuts windows and changes nothing in them."""

from lidarpainter_models.painter.augmentation import AugmentationConfig

QUIET = AugmentationConfig(
    crop_px=32,
    lidar_dropout_share=0,
    lidar_thinning_share=0,
    warp_dropout_share=0,
    warp_swap_share=0,
    damage_share=0,
    identity_share=0,
    gain_range=0,
    tint_range=0,
    mismatch_range=0,
)
