"""`cargo bench --bench ops -- planes_step` in PyTorch: a training step of a factored field (TensoRF).

    python benches/peers/planes_step.py [--look-up embedding_bag|grid_sample] [--compile] [--mixed] [--threads N] [--repeats N]

4096 rays of 64 samples, each with a color; planes of 300 x 300 nodes with 16 components of density and 48 of appearance; 32 features and 16
harmonics of the direction; a network of width 128; mean square of the colors; Adam. Here Adam updates all rows of the planes. The Rust bench updates those
that were read, and also computes depth, opacity and distortion. Needs PyTorch.
"""

import argparse

from protocol import measure, options

import torch
import torch.nn.functional as F

SIDE, RAYS, SAMPLES = 300, 4096, 64
DENSITY, APPEARANCE, FEATURES, HARMONICS, WIDTH = 16, 48, 32, 16, 128
# Axes of each plane, and the axis of its line.
MODES = [((0, 1), 2), ((0, 2), 1), ((1, 2), 0)]


def corners(x):
    """Rows and weights of the nodes around positions `x` of [n, dimensions], in cells."""
    low = x.floor().clamp(0, SIDE - 2)
    share = x - low
    low = low.to(torch.int64)
    rows, weights = torch.zeros(len(x), 1, dtype=torch.int64), torch.ones(len(x), 1)
    for axis in range(x.shape[1]):
        at, part = low[:, axis, None], share[:, axis, None]
        rows = torch.cat([rows * SIDE + at, rows * SIDE + at + 1], 1)
        weights = torch.cat([weights * (1 - part), weights * part], 1)
    return rows, weights


class Bags(torch.nn.Module):
    """Planes and lines as tables of rows, read by `embedding_bag`."""

    def __init__(self, components):
        super().__init__()
        table = lambda dimensions: torch.nn.Parameter(0.1 * torch.randn(SIDE**dimensions, components))
        self.planes = torch.nn.ParameterList(table(2) for _ in MODES)
        self.lines = torch.nn.ParameterList(table(1) for _ in MODES)

    def forward(self, places):
        read = lambda table, place: F.embedding_bag(place[0], table, mode="sum", per_sample_weights=place[1])
        return [read(plane, p) * read(line, l) for plane, line, (p, l) in zip(self.planes, self.lines, places)]

    @staticmethod
    def places(x):
        return [(corners(x[:, plane]), corners(x[:, [line]])) for plane, line in MODES]


class Grids(torch.nn.Module):
    """Planes and lines as images, read by `grid_sample`, as in the authors' program."""

    def __init__(self, components):
        super().__init__()
        image = lambda width: torch.nn.Parameter(0.1 * torch.randn(1, components, SIDE, width))
        self.planes = torch.nn.ParameterList(image(SIDE) for _ in MODES)
        self.lines = torch.nn.ParameterList(image(1) for _ in MODES)

    def forward(self, places):
        read = lambda image, place: F.grid_sample(image, place, align_corners=True)[0, :, :, 0]
        return [(read(plane, p) * read(line, l)).t() for plane, line, (p, l) in zip(self.planes, self.lines, places)]

    @staticmethod
    def places(x):
        x = x / (SIDE - 1) * 2 - 1
        of = lambda a, b: torch.stack([a, b], 1).view(1, -1, 1, 2)
        # The first number is the column, the second one the row.
        return [(of(x[:, plane[1]], x[:, plane[0]]), of(torch.zeros(len(x)), x[:, line])) for plane, line in MODES]


class Field(torch.nn.Module):
    def __init__(self, kind, mixed):
        super().__init__()
        self.mixed, self.kind, self.density, self.appearance = mixed, kind, kind(DENSITY), kind(APPEARANCE)
        self.basis = torch.nn.Linear(3 * APPEARANCE, FEATURES, bias=False)
        layers = [torch.nn.Linear(FEATURES + HARMONICS, WIDTH), torch.nn.Linear(WIDTH, WIDTH), torch.nn.Linear(WIDTH, 3)]
        self.network = torch.nn.Sequential(layers[0], torch.nn.ReLU(True), layers[1], torch.nn.ReLU(True), layers[2])

    def forward(self, x, harmonics, delta):
        places = self.kind.places(x)
        density = sum(part.sum(1) for part in self.density(places))
        sigma = 25 * F.softplus(density - 10).view(RAYS, SAMPLES)
        depth = sigma * delta
        weights = (1 - torch.exp(-depth)) * torch.exp(depth - depth.cumsum(1))
        products = torch.cat(self.appearance(places), 1)
        directions = harmonics[:, None].expand(-1, SAMPLES, -1).reshape(-1, HARMONICS)
        with torch.autocast("cpu", torch.bfloat16, self.mixed):
            color = self.network(torch.cat([self.basis(products), directions], 1))
        color = torch.sigmoid(color.float()).view(RAYS, SAMPLES, 3)
        return (weights[..., None] * color).sum(1) + (1 - weights.sum(1, keepdim=True))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--look-up", choices=["embedding_bag", "grid_sample"], default="embedding_bag")
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--mixed", action="store_true", help="matrix and network under torch.autocast to bfloat16, for `planes_step_mixed`")
    args = options(parser)
    field = Field(Bags if args.look_up == "embedding_bag" else Grids, args.mixed)
    function = torch.compile(field) if args.compile else field
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-3, betas=(0.9, 0.99), fused=True)
    across = torch.rand(RAYS, 1, 2).expand(-1, SAMPLES, -1)
    along = ((torch.arange(SAMPLES) + 0.5) / SAMPLES).view(1, -1, 1).expand(RAYS, -1, -1)
    x = torch.cat([across, along], 2).reshape(-1, 3) * (SIDE - 1)
    harmonics = torch.randn(1, HARMONICS).expand(RAYS, -1)
    forward = lambda: function(x, harmonics, 2 / SAMPLES)

    def step():
        optimizer.zero_grad(set_to_none=True)
        forward().square().mean().backward()
        optimizer.step()

    name = "planes_step_mixed" if args.mixed else "planes_step"
    measure(name, args, f"{args.look_up}{', compiled' if args.compile else ''}", forward, step)


if __name__ == "__main__":
    main()
