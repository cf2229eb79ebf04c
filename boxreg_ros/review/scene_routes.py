"""Requests of the page about the recording: sweeps, boxes for added objects, whole clouds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from boxreg_ros.errors import RecordingError
from boxreg_ros.review.added import added_track
from boxreg_ros.review.fit import drawn, fitted, USUAL_EXTENTS
from boxreg_ros.review.payload import as_json
from boxreg_ros.review.requests import box_of, numbers_of, posted, stamp_of, text_of
from boxreg_ros.review.scene import DriveImages, DriveScene, DriveSource, thinned
from boxreg_ros.structures import BoxArray, Floats, is_valid_box
import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

MAX_SCENE_BOXES = 20_000
"""Most boxes of a request: a track of half an hour; chosen."""


class SceneRoutes:
    """Answer the requests about a drive."""

    def __init__(self, source: DriveSource, frame_id: str) -> None:
        self._scene = DriveScene(source)
        self._images = DriveImages(source, self._scene)
        self._frame_id = frame_id

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route('/sweep', self.sweep),
            Route('/fit', posted(self._fit), methods=['POST']),
            Route('/follow', posted(self._follow), methods=['POST']),
            Route('/cameras', self.cameras),
            Route('/image', self.image),
            Route('/accumulated', posted(self._accumulated), methods=['POST']),
        ]

    async def sweep(self, request: Request) -> Response:
        """Return the sweep nearest to a stamp: stamp, origin, sensor, points."""
        stamp_ns = _needed_stamp(request.query_params)
        return await run_in_threadpool(self._sweep, stamp_ns)

    async def cameras(self, request: Request) -> Response:
        """Return the cameras, with their poses at a stamp."""
        stamp_ns = _needed_stamp(request.query_params)
        found = await run_in_threadpool(self._images.cameras, stamp_ns)
        return Response(as_json(found), media_type='application/json')

    async def image(self, request: Request) -> Response:
        """Return the image of a camera that is nearest to a stamp."""
        number = request.query_params.get('camera', '')
        if not number.isdecimal() or len(number) > 4:
            raise RecordingError(f'camera: expected a number, got {number!r:.80}')
        stamp_ns = _needed_stamp(request.query_params)
        found, pose = await run_in_threadpool(self._images.image, int(number), stamp_ns)
        headers = {'X-Stamp': str(found.stamp_ns), 'X-Pose': as_json(pose).decode()}
        return Response(found.content, media_type=found.media_type, headers=headers)

    def _sweep(self, stamp_ns: int) -> Response:
        found_ns, origin, points, sensor = self._scene.sweep(stamp_ns)
        head = np.int64(found_ns).tobytes() + np.concatenate([origin, sensor]).tobytes()
        return _bytes(head + points.tobytes())

    def _fit(self, sent: Mapping[str, Any]) -> bytes:
        """Return the box of the object at a place, or of one that is drawn from there."""
        extents = _extents_of(sent.get('extents'))
        name = text_of(sent, 'class')
        if name:
            extents = {name: extents.get(name, USUAL_EXTENTS.get(name, USUAL_EXTENTS['car']))}
        _, origin, points, sensor = self._scene.sweep(_needed_stamp(sent))
        place = numbers_of(sent.get('place'), 'place', 2) - origin[:2]
        if 'front' in sent:  # drawn from its rear, the place
            front = numbers_of(sent.get('front'), 'front', 2) - origin[:2]
            found = drawn(points, place, front, extents if name else USUAL_EXTENTS | extents)
        else:
            found = fitted(points, place, sensor[:2] - origin[:2], float(sensor[3]), extents)
        box = found.box + np.append(origin, np.zeros(6))
        answer = {'box': box, 'class': found.class_name, 'points': found.num_points}
        return as_json(answer)

    def _follow(self, sent: Mapping[str, Any]) -> bytes:
        """Return the track of an object from its boxes."""
        names = (text_of(sent, 'id'),), (text_of(sent, 'class'),)
        begin_ns = stamp_of(sent, 'begin_ns') or 0
        seeds = []
        for seed in _objects_of(sent.get('seeds'), 'seeds'):
            box = box_of(seed.get('box'))[None]
            seeds.append(BoxArray(_needed_stamp(seed), self._frame_id, *names, np.ones(1), box))
        grows = sent.get('grows') is True
        return as_json(added_track(self._scene, seeds, begin_ns, grows))

    def _accumulated(self, sent: Mapping[str, Any]) -> Response:
        """Return the points of all sweeps in the boxes of a track."""
        rows = _objects_of(sent.get('boxes'), 'boxes')
        stamps_ns = [_needed_stamp(row) for row in rows]
        boxes = np.array([box_of(row.get('box')) for row in rows])
        if not is_valid_box(boxes).all():
            raise RecordingError('boxes: expected finite numbers and positive extents')
        points = thinned(self._scene.near(stamps_ns, boxes))
        return _bytes(points.astype(np.float32).tobytes())


def _bytes(content: bytes) -> Response:
    return Response(content, media_type='application/octet-stream')


def _needed_stamp(sent: Mapping[str, Any]) -> int:
    stamp_ns = stamp_of(sent, 'stamp')
    if stamp_ns is None:
        raise RecordingError('stamp: expected nanoseconds, got none')
    return stamp_ns


def _objects_of(sent: object, name: str) -> list[Mapping[str, Any]]:
    if not isinstance(sent, list) or not 0 < len(sent) <= MAX_SCENE_BOXES:
        raise RecordingError(
            f'{name}: expected 1 to {MAX_SCENE_BOXES} in a list, got {sent!r:.80}'
        )
    if not all(isinstance(one, dict) for one in sent):
        raise RecordingError(f'{name}: expected objects in a list')
    return sent


def _extents_of(sent: object) -> dict[str, Floats]:
    """Return the extents (3,) of classes; those that are no size are left out."""
    if not isinstance(sent, dict):
        return {}
    found = {name: numbers_of(one, 'extents', 3) for name, one in sent.items()}
    return {name: one for name, one in found.items() if (one > 0).all()}
