"""`cargo bench --bench ops -- hash_step` in PyTorch: a training step of a hash grid with a network (Instant-NGP).

    python benches/peers/hash_step.py [--eager] [--threads N] [--repeats N]

16 levels of two features, 16 to 2048 nodes a side, 2^19 rows a level; the layers 32, 64, 16; 262 144 positions; mean square; Adam. Here Adam
updates all rows of the table. The Rust bench updates those that were read: 98 % of the hashed ones. Rows and weights of corners are compiled by `torch.compile`
unless `--eager` is given. Needs PyTorch.
"""

import argparse
import math

from protocol import measure, options

import torch
import torch._dynamo

LEVELS, FEATURES, LOG2_ROWS, BASE, GROWTH, POSITIONS = 16, 2, 19, 16, 128 ** (1 / 15), 1 << 18
PRIMES = (1, 2654435761, 805459861)


def shapes():
    """Scale, nodes a side, rows, and whether rows are hashed, of each level."""
    for level in range(LEVELS):
        scale = BASE * GROWTH**level - 1
        side = math.ceil(scale) + 1
        yield scale, side, min((side**3 + 7) // 8 * 8, 1 << LOG2_ROWS), side**3 > 1 << LOG2_ROWS


def corners(x, scale, side, rows, hashed):
    """Rows and weights of the eight corners around each position of `x`, [3, n]."""
    at = x * scale + 0.5
    low = at.floor()
    share = at - low
    low = low.to(torch.int32)
    signed = lambda k: k - (1 << 32) if k >= 1 << 31 else k
    factors = [signed(p) for p in PRIMES] if hashed else [1, side, side * side]
    near = [low[k] * factors[k] for k in range(3)]
    far = [near[k] + factors[k] for k in range(3)]
    index, weight = [], []
    for corner in range(8):
        own = [(far if corner >> k & 1 else near)[k] for k in range(3)]
        if hashed:
            row = (own[0] ^ own[1] ^ own[2]) & (rows - 1)
        else:
            row = own[0] + own[1] + own[2]
            row = torch.where(row < rows, row, row - rows)
        index.append(row.to(torch.int64))
        parts = [share[k] if corner >> k & 1 else 1 - share[k] for k in range(3)]
        weight.append(parts[0] * parts[1] * parts[2])
    return torch.stack(index).view(-1), torch.stack(weight)


class Encode(torch.autograd.Function):
    """One gather and one `scatter_add_` for each level. The features are rows of a table, so that PyTorch uses a thread for each."""

    @staticmethod
    def forward(ctx, x, find, levels, *tables):
        ctx.found = [find(x, *level) for level in levels]
        ctx.rows = [level[2] for level in levels]
        out = torch.empty(LEVELS * FEATURES, x.shape[1])
        for level, (index, weight) in enumerate(ctx.found):
            values = tables[level].gather(1, index.expand(FEATURES, -1)).view(FEATURES, 8, -1).mul_(weight)
            torch.sum(values, 1, out=out[level * FEATURES : (level + 1) * FEATURES])
        return out.t()

    @staticmethod
    def backward(ctx, cotangent):
        cotangent = cotangent.t()
        gradients = []
        for level, (index, weight) in enumerate(ctx.found):
            gradient = torch.zeros(FEATURES, ctx.rows[level])
            values = weight * cotangent[level * FEATURES : (level + 1) * FEATURES, None]
            gradient.scatter_add_(1, index.expand(FEATURES, -1), values.view(FEATURES, -1))
            gradients.append(gradient)
        return (None, None, None, *gradients)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--eager", action="store_true")
    args = options(parser)
    torch._dynamo.config.recompile_limit = 64
    find = corners if args.eager else torch.compile(corners, dynamic=False)
    levels = list(shapes())
    tables = [torch.nn.Parameter(1e-4 * torch.rand(FEATURES, rows)) for _, _, rows, _ in levels]
    network = torch.nn.Sequential(torch.nn.Linear(LEVELS * FEATURES, 64), torch.nn.ReLU(inplace=True), torch.nn.Linear(64, 16))
    optimizer = torch.optim.Adam([*tables, *network.parameters()], lr=1e-3, betas=(0.9, 0.99), fused=True)
    x = torch.rand(3, POSITIONS)
    forward = lambda: network(Encode.apply(x, find, levels, *tables))

    def step():
        optimizer.zero_grad(set_to_none=True)
        forward().square().mean().backward()
        optimizer.step()

    measure("hash_step", args, "eager" if args.eager else "corners compiled", forward, step)


if __name__ == "__main__":
    main()
