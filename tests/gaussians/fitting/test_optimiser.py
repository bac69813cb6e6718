import torch

from lidarpainter_models.gaussians.fitting.learning_rates import LearningRates
from lidarpainter_models.gaussians.fitting.refinement import RowAdam


def test_rates_fall_exponentially_from_first_to_last():
    rates = LearningRates(means=(0.16, 0.01))
    assert [round(rates.at("means", part), 6) for part in (0.0, 0.5, 1.0, 2.0)] == [
        0.16,
        0.04,
        0.01,
        0.01,
    ]


def test_rows_without_gradient_do_not_drift():
    table = torch.zeros(3, 2).double()
    adam = RowAdam(table)
    rate = torch.tensor([0.1, 0.2]).double()
    gradient = torch.zeros(3, 2).double()
    gradient[1] = torch.tensor([4.0, -4.0])
    adam.step(table, gradient, rate)
    adam.step(table, torch.zeros(3, 2).double(), rate)
    assert torch.allclose(table[1], torch.tensor([-0.1, 0.2]).double())
    assert float(table[[0, 2]].abs().max()) == 0
    assert adam.count.tolist() == [0, 1, 0]
