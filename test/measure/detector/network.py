"""A small detector: a convolutional network on a grid from above, with a heatmap of centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from boxreg_ros.offline.box_scores import pairwise_iou
from boxreg_ros.rotations import wrap_angle
from boxreg_ros.structures import BOX_EXTENT, Floats, Ints, LENGTH, ROLL, WIDTH, YAW, Z
from measure.detector.frames import (
    CELL,
    CHANNELS,
    Frame,
    grid_of,
    NUM_VALUES,
    REACH,
    STRIDE,
    turned,
)
import numpy as np
import torch
from torch import nn, Tensor
from torch.nn import functional

CLASSES = ('car', 'truck', 'pedestrian', 'cyclist')
CROP = 96
"""Side of the part of a grid that is one sample of the training [cells]."""
CROP_SHIFT = 14.0
"""Greatest distance of its centre to that of a box [m], per axis."""
TURN = 0.3
"""Greatest angle by which a sample is turned, beside half a turn [rad]."""
BATCH = 8
LEARNING_RATE = 4e-3
WEIGHT_DECAY = 1e-4
VALUES_WEIGHT = 2.0
"""Weight of the loss of the values of boxes beside that of the heatmaps."""
PEAK_SPREAD = 6.0
"""Root of the area of a footprint over the standard deviation of its peak in the heatmap."""
MIN_SCORE = 0.05
MAX_DETECTIONS = 120
MAX_OVERLAP = 0.15
"""IoU from above at which the box with the lower score is left out."""


@dataclass(frozen=True, slots=True)
class Labels:
    """Boxes (n, 9) as `Frame.local`, and the rows (n,) of their classes in `CLASSES`."""

    boxes: Floats
    classes: Ints


class Detector(nn.Module):
    """Three levels of convolutions, added up at the first, and two layers for the output."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = _block(CHANNELS, 16)
        self.first = nn.Sequential(_block(16, 32, 2), _block(32, 32))
        self.second = nn.Sequential(_block(32, 64, 2), _block(64, 64))
        self.third = nn.Sequential(_block(64, 96, 2), _block(96, 96))
        self.from_third = nn.Conv2d(96, 64, 1)
        self.from_second = nn.Conv2d(64, 32, 1)
        self.neck = _block(32, 48)
        self.head = nn.Conv2d(48, len(CLASSES) + NUM_VALUES, 1)
        nn.init.constant_(self.head.bias[: len(CLASSES)], -4.0)  # few cells have a centre

    def forward(self, grid: Tensor) -> Tensor:
        """Return logits of the classes and values of the boxes (B, classes + values, n, n)."""
        first = self.first(self.stem(grid))
        second = self.second(first)
        third = self.from_third(self.third(second))
        second = second + functional.interpolate(third, scale_factor=2.0)
        first = first + functional.interpolate(self.from_second(second), scale_factor=2.0)
        found = self.neck(first).float()
        with torch.autocast('cpu', enabled=False):  # scores and values need their digits
            return self.head(found)


def _block(channels: int, wanted: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, wanted, 3, stride, 1, bias=False),
        nn.BatchNorm2d(wanted),
        nn.ReLU(inplace=True),
    )


def targets_of(labels: Labels, corner: Floats, size: int) -> tuple[Floats, Floats, Floats]:
    """
    Return what the network should return for labels, on `size` cells from `corner` (2,) on.

    Heatmaps (classes, size, size) with a Gaussian peak in the cell of each centre, the values
    (NUM_VALUES, size, size) in this cell and its neighbours, and the mask (size, size) of these.

    """
    heat = np.zeros((len(CLASSES), size, size), np.float32)
    values = np.zeros((NUM_VALUES, size, size), np.float32)
    mask = np.zeros((size, size), np.float32)
    nearest = np.full((size, size), np.inf)
    places = (labels.boxes[:, :2] - corner) / (CELL * STRIDE)
    for box, kind, (x, y) in zip(labels.boxes, labels.classes, places, strict=True):
        if not (0 <= x < size and 0 <= y < size):
            continue
        spread = max(np.sqrt(box[LENGTH] * box[WIDTH]) / PEAK_SPREAD / (CELL * STRIDE), 0.5)
        reach = int(np.ceil(3 * spread))
        row, column = int(y), int(x)
        rows = np.arange(max(row - reach, 0), min(row + reach + 1, size))[:, None]
        columns = np.arange(max(column - reach, 0), min(column + reach + 1, size))
        square = (rows - row) ** 2 + (columns - column) ** 2
        peak = np.exp(-square / (2 * spread**2))
        heat[kind, rows, columns] = np.maximum(heat[kind, rows, columns], peak)
        own = (square <= 2) & (square < nearest[rows, columns])
        rows, columns = (np.broadcast_to(places, own.shape)[own] for places in (rows, columns))
        square = square[own]
        nearest[rows, columns] = square
        mask[rows, columns] = 1
        values[0, rows, columns] = x - columns - 0.5
        values[1, rows, columns] = y - rows - 0.5
        turns = [f(k * box[YAW]) for k in (2, 1) for f in (np.sin, np.cos)]
        others = [box[Z], *np.log(box[BOX_EXTENT]), *turns]
        values[2:, rows, columns] = np.array(others)[:, None]
    return heat, values, mask


def decoded(values: Floats, rows: Ints, columns: Ints, corner: Floats) -> Floats:
    """Return the boxes (n, 9) of the values (NUM_VALUES, n) in cells of the heatmaps."""
    boxes = np.zeros((len(rows), 9))
    boxes[:, 0] = (columns + 0.5 + values[0]) * CELL * STRIDE + corner[0]
    boxes[:, 1] = (rows + 0.5 + values[1]) * CELL * STRIDE + corner[1]
    boxes[:, 2] = values[2]
    boxes[:, BOX_EXTENT] = np.exp(np.clip(values[3:6], -3, 4)).T
    axis = np.arctan2(values[6], values[7]) / 2
    is_ahead = np.cos(axis) * values[9] + np.sin(axis) * values[8] >= 0
    boxes[:, YAW] = wrap_angle(np.where(is_ahead, axis, axis + np.pi))
    return boxes


def loss_of(output: Tensor, heat: Tensor, values: Tensor, mask: Tensor) -> Tensor:
    """Return the focal loss of the heatmaps plus the weighted L1 loss of the values."""
    logits, found = output[:, : len(CLASSES)], output[:, len(CLASSES) :]
    is_peak = heat == 1
    chance = logits.sigmoid()
    missed = -functional.logsigmoid(logits) * (1 - chance) ** 2
    false = -functional.logsigmoid(-logits) * chance**2 * (1 - heat) ** 4
    of_heat = torch.where(is_peak, missed, false).sum() / is_peak.sum().clamp(min=1)
    away = ((found - values).abs() * mask[:, None]).sum() / mask.sum().clamp(min=1)
    return of_heat + VALUES_WEIGHT * away / NUM_VALUES * 4


def trained(
    frames: Sequence[Frame],
    labels: Sequence[Labels],
    steps: int,
    seed: int,
    start: Detector | None = None,
) -> Detector:
    """Return a detector trained on labels of frames, one each; it begins as `start`."""
    rng = np.random.default_rng(seed)
    torch.manual_seed(seed)
    model = Detector()
    if start is not None:
        model.load_state_dict(start.state_dict())
    model = model.to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(model.parameters(), LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, steps)
    for _ in range(steps):
        samples = []
        for row in rng.integers(0, len(frames), BATCH):
            samples.append(_sample(frames[row], labels[row], rng))
        grid, heat, values, mask = (
            torch.from_numpy(np.stack(arrays)) for arrays in zip(*samples, strict=True)
        )
        grid = grid.contiguous(memory_format=torch.channels_last)
        with torch.autocast('cpu', torch.bfloat16):
            output = model(grid)
        loss = loss_of(output, heat, values, mask)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(model.parameters(), 10.0)
        optimizer.step()
        schedule.step()
    return model.eval()


def _sample(frame: Frame, labels: Labels, rng: np.random.Generator) -> tuple[Floats, ...]:
    """Return grid and targets of a part of a frame near one of its boxes, at a random angle."""
    angle = rng.uniform(-TURN, TURN) + np.pi * rng.integers(2)
    is_mirrored = rng.random() < 0.5
    points, boxes = turned(frame.points, labels.boxes, angle, is_mirrored)
    middle = rng.uniform(-REACH / 2, REACH / 2, 2)
    if len(boxes):
        middle = boxes[rng.integers(len(boxes)), :2] + rng.uniform(-CROP_SHIFT, CROP_SHIFT, 2)
    corner = middle - CROP * CELL / 2
    cell = CELL * STRIDE
    corner = np.round(corner / cell) * cell
    targets = targets_of(Labels(boxes, labels.classes), corner, CROP // STRIDE)
    return grid_of(points, corner, CROP), *targets


@torch.no_grad()
def detections(model: Detector, frame: Frame) -> tuple[Labels, Floats]:
    """Return the boxes of a frame, in its axes, and their scores, the highest first."""
    corner = np.array([-REACH, -REACH])
    grid = torch.from_numpy(grid_of(frame.points, corner, round(2 * REACH / CELL)))[None]
    with torch.autocast('cpu', torch.bfloat16):
        output = model(grid.contiguous(memory_format=torch.channels_last))[0]
    scores = output[: len(CLASSES)].sigmoid()
    peaks = functional.max_pool2d(scores[None], 3, 1, 1)[0]
    kept = torch.where((scores == peaks) & (scores > MIN_SCORE), scores, 0).flatten()
    best, places = kept.topk(MAX_DETECTIONS)
    kinds, rows, columns = np.unravel_index(places[best > 0].numpy(), scores.shape)
    values = output[len(CLASSES) :, rows, columns].numpy().astype(np.float64)
    boxes = decoded(values, rows, columns, corner)
    chosen = without_overlaps(boxes)
    return Labels(boxes[chosen], kinds[chosen]), best[best > 0].numpy()[chosen].astype(np.float64)


def flat(boxes: Floats) -> Floats:
    """Return footprints (n, 9) of boxes as boxes of one height: their 3D IoU is that in BEV."""
    footprints = boxes.copy()
    footprints[:, [2, 5]] = [0.0, 1.0]
    footprints[:, ROLL:YAW] = 0
    return footprints


def without_overlaps(boxes: Floats) -> Ints:
    """Return the rows of the boxes (n, 9), best first, that no better one overlaps."""
    overlaps = pairwise_iou(flat(boxes), flat(boxes)) > MAX_OVERLAP
    kept: list[int] = []
    for row in range(len(boxes)):
        if not overlaps[row, kept].any():
            kept.append(row)
    return np.array(kept, np.int64)
