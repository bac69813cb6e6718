"""The three functions of gsplat that the CUDA backend calls, as its documentation describes them.

Plain torch on any device, shapes checked as gsplat 1.5.3 states them. It stands in for gsplat where
there is no GPU: it tells whether the backend calls gsplat rightly, not whether gsplat is right.
"""

import torch

DEPTH_BITS = 32
TOP = 0.999
CUT = 1.0 / 255.0
STOP = 1e-4


def isect_tiles(
    means2d,
    radii,
    depths,
    tile_size,
    tile_width,
    tile_height,
    sort=True,
    segmented=False,
    packed=False,
    n_images=None,
    image_ids=None,
    gaussian_ids=None,
):
    """Tiles per Gaussian, ids of the intersections (image, tile, depth), and their rows."""
    assert sort
    assert not segmented
    assert packed, "the form that the backend uses"
    nnz = means2d.shape[0]
    assert image_ids.shape == gaussian_ids.shape == (nnz,)
    assert int(image_ids.max()) < n_images
    image = image_ids
    dims = means2d.shape[:-1]
    assert radii.shape == (*dims, 2)
    assert radii.dtype == torch.int32
    assert depths.shape == dims
    centre, radius = means2d.reshape(nnz, 2), radii.reshape(nnz, 2)
    grid = torch.tensor([tile_width, tile_height])
    low = ((centre - radius) / tile_size).floor().long().clamp(min=0)
    high = torch.minimum(((centre + radius) / tile_size).ceil().long(), grid)
    found: list[int] = []
    rows, counts = [], []
    depth_bits = depths.reshape(nnz).view(torch.int32).long()
    for row in range(nnz):
        before = len(found)
        for y in range(int(low[row, 1]), int(high[row, 1])):
            for x in range(int(low[row, 0]), int(high[row, 0])):
                tile = (int(image[row]) * tile_height + y) * tile_width + x
                found.append((tile << DEPTH_BITS) | int(depth_bits[row]))
                rows.append(row)
        counts.append(len(found) - before)
    keys, order = torch.tensor(found, dtype=torch.int64).sort(stable=True)
    return torch.tensor(counts).reshape(dims), keys, torch.tensor(rows, dtype=torch.int32)[order]


def isect_offset_encode(isect_ids, n_images, tile_width, tile_height):
    """Where each tile's intersections begin, (images, tile_height, tile_width)."""
    tiles = torch.arange(n_images * tile_height * tile_width)
    first = torch.searchsorted(isect_ids >> DEPTH_BITS, tiles)
    return first.reshape(n_images, tile_height, tile_width).int()


def rasterize_to_pixels(
    means2d,
    conics,
    colors,
    opacities,
    image_width,
    image_height,
    tile_size,
    isect_offsets,
    flatten_ids,
    packed=False,
    absgrad=False,
):
    """Values (images, height, width, channels) and alpha; with `absgrad` see the documentation."""
    dims = means2d.shape[:-1]
    assert packed
    assert len(dims) == 1
    assert means2d.is_contiguous()
    assert conics.shape == (*dims, 3)
    assert opacities.shape == dims
    assert colors.shape[:-1] == dims
    splats = [value.reshape(-1, *value.shape[len(dims) :]) for value in (means2d, conics, colors)]
    splats.append(opacities.reshape(-1))
    watched = _AbsoluteGradient(means2d) if absgrad else None
    ends = torch.cat([isect_offsets.reshape(-1), torch.tensor([len(flatten_ids)])]).tolist()
    images, rows, columns = isect_offsets.shape
    values = torch.zeros(images, rows * tile_size, columns * tile_size, colors.shape[-1])
    values, alpha = values.to(colors), torch.zeros(values.shape[:-1]).to(colors)
    for tile in range(images * rows * columns):
        chosen = flatten_ids[ends[tile] : ends[tile + 1]].long()
        image, y, x = tile // (rows * columns), tile // columns % rows, tile % columns
        part = (
            image,
            slice(y * tile_size, (y + 1) * tile_size),
            slice(x * tile_size, (x + 1) * tile_size),
        )
        corner = torch.tensor([x, y]) * tile_size
        values[part], alpha[part] = _tile(splats, chosen, corner, tile_size, watched)
    crop = (slice(None), slice(image_height), slice(image_width))
    return values[crop], alpha[crop][..., None]


def _tile(splats, chosen, corner, size, watched):
    centre, conic, colour, opacity = (value[chosen] for value in splats)
    steps = torch.arange(size) + 0.5
    y, x = torch.meshgrid(steps + corner[1], steps + corner[0], indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 1, 2).to(centre)
    offset = centre[None] - pixels
    if watched is not None and offset.requires_grad:
        offset.register_hook(lambda gradient: watched.add(chosen, gradient))
    dx, dy = offset.unbind(dim=-1)
    sigma = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
    alpha = (opacity * torch.exp(-sigma)).clamp(max=TOP)
    alpha = torch.where(alpha >= CUT, alpha, 0.0)
    left = torch.cumprod(1 - alpha, dim=1)
    alpha = alpha * (left.detach() > STOP)
    left = torch.cumprod(1 - alpha, dim=1)
    ones = left.new_ones(len(left), 1)
    before = torch.cat([ones, left], dim=1)
    values = (alpha * before[:, :-1]) @ colour
    return values.reshape(size, size, -1), 1 - before[:, -1].reshape(size, size)


class _AbsoluteGradient:
    """Fills `means2d.absgrad` while a backward pass runs."""

    def __init__(self, means2d):
        self._sums = torch.zeros_like(means2d.detach()).reshape(-1, 2)
        means2d.absgrad = self._sums.view_as(means2d)

    def add(self, chosen, gradient):
        self._sums.index_add_(0, chosen, gradient.abs().sum(dim=0))
