"""What stands in for Inception, whose weights nobody here has."""

import torch

from lidarpainter_models.metrics.inception import Inception


class MeansAsFeatures(Inception):
    """Colours and rows of an image in place of what a network sees in it."""

    def __init__(self):
        torch.nn.Module.__init__(self)

    def features_of(self, images):
        return torch.stack([torch.tensor([*image.mean((0, 1)), len(image)]) for image in images])
