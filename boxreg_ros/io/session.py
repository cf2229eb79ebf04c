"""
Preparation of sweeps and boxes for the registrar, the same for the live node and for recordings.

A `Session` brings each item into the fixed frame, merges the clouds of several LiDARs, assigns ids
where they are asked for, and checks the input. `hand_to_registrar` adds the result to the
registrar. The live node adds waiting for transforms and publishing; `boxreg relabel` adds reading
and writing.

"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from boxreg_ros.config import Config
from boxreg_ros.errors import TransformUnavailable
from boxreg_ros.io.checks.finding import Finding
from boxreg_ros.io.checks.input_checks import InputChecks
from boxreg_ros.io.id_assignment import IdCheck, Tracker
from boxreg_ros.io.items import Item
from boxreg_ros.io.lidars import ignore, MergedSweep, Report, SensorPlacement, SweepMerger
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.io.transforms import boxes_to_frame, sweep_to_frame
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, KEPT, RefinedBoxes, Sweep
from msg_adapters.convention import Convention
from msg_adapters.poses import turned_covariances
import numpy as np

if TYPE_CHECKING:  # it imports torch, which a process that only reads does not need
    from boxreg_ros.core.registrar import BoxRegistrar

CLOUDS_WITHOUT_FRAME = (
    "clouds have an empty frame_id: expected the name of the LiDAR's frame in TF; name it with "
    "sensor_frames:=['FRAME'] (boxreg relabel: --sensor-frame FRAME), or set it in the driver"
)
"""What to do about clouds without a frame."""
BOXES_WITHOUT_FRAME = (
    'boxes have an empty frame_id: expected the name of their frame; they are taken to be in that '
    'of the clouds, {!r}'
)
BOXES_WITHOUT_IDS = (
    'no box has a track id: boxes are associated over time; set associate:=true to confirm that'
)
SAME_FRAMES = (
    'frames: expected one name for each, got names that differ by a prefix alone: {}; each pair '
    'is taken for one frame, since nothing else connects them'
)
ASSOCIATE = 'set associate:=true (boxreg relabel: --associate)'
REPLACED_IDS = (
    'boxes are associated over time instead from here on; set associate:=true to do so from the '
    'start, or keep_ids:=true to take the ids as they are'
)


@dataclass(eq=False, repr=False)
class Session:
    """
    Prepare sweeps and boxes for the registrar.

    State: the transforms, the clouds that wait for those of other LiDARs, the tracks of id
    assignment, and the checks of the input. Not thread-safe.

    Adapters have applied the `convention` already; the checks compare it with others. Of
    `config`, `max_gap` and `merge_span` are used; `report` is called for clouds that are not
    merged. The caller feeds `tree` and `placement`, and sets `sensor_frame`, that of the point
    clouds, by which `fixed_frame` is chosen where it is empty.

    """

    convention: Convention
    config: Config
    fixed_frame: str = ''
    placement: SensorPlacement = field(default_factory=SensorPlacement)
    report: Report = ignore

    def __post_init__(self) -> None:
        """Begin with no message."""
        convention, config = self.convention, self.config
        # The node estimates early and final boxes before it has transforms from behind a gap.
        self.tree = TransformTree(looks_ahead=config.estimate == 'track')
        self.fixed_frame = self.fixed_frame.lstrip('/')
        self.sensor_frame = ''
        self.trusts_ids = False  # they are a person's: boxes at few sweeps do not show them
        self.leaves_frames_that_jump = False  # of those it has chosen, see `fixed_frame_jumps`
        self.left_frame = ''  # the first one
        self._chooses_frame = not self.fixed_frame
        self.assigns_ids = False  # to all boxes, while none has had an id, or they jump
        self._has_ids = self._has_assigned = False
        lidars = self.placement.lidars
        self._merger: SweepMerger | None = None
        if len(lidars.topics) > 1:
            self._merger = SweepMerger(lidars.topics, config.merge_span, self.report)
        self._checks = InputChecks(convention, config, self.tree, lidars)
        self._id_check = None if convention.associate else IdCheck(config.max_gap)
        self._tracker = self._id_check.tracker if self._id_check else Tracker(config.max_gap)
        self._boxes_without_frame = ''
        self._odometry_lacks_child = False
        self._has_clouds_without_frame = False

    def restart(self) -> None:
        """Forget all but the transforms; ids that were assigned are not used again."""
        self._checks.restart()
        for part in (self._merger, self._id_check or self._tracker):
            if part is not None:
                part.forget()

    def admit(self, item: Item, ticket: object = None) -> Item:
        """
        Return an item with its sweep or boxes in the fixed frame, boxes with ids.

        Parameters
        ----------
        item : Item
            Received by the clock of the transforms in `tree`.
        ticket : object
            Of the boxes in the fixed frame.

        """
        given = item.content
        if is_placeholder(given):
            return item
        if isinstance(given, BoxArray) and not given.frame_id and self.sensor_frame:
            given = replace(given, frame_id=self.sensor_frame)
            self._boxes_without_frame = BOXES_WITHOUT_FRAME.format(self.sensor_frame)
        try:
            fixed_frame = self.require_fixed_frame(given)
            self._checks.add_received(given, fixed_frame, item.received_ns)
            T_fixed_item = self.tree.lookup(fixed_frame, given.frame_id, given.stamp_ns)
        except TransformUnavailable as error:
            is_sweep = isinstance(given, Sweep)
            missing = Reason.SWEEP_WITHOUT_TRANSFORM if is_sweep else Reason.NO_TRANSFORM
            self._name_odometry_child()
            return item._replace(reason=missing, detail=str(error))
        reason, detail = None, ''
        moved: Sweep | BoxArray
        if isinstance(given, Sweep):
            moved = sweep_to_frame(given, T_fixed_item, self.fixed_frame)
            moved, reason, detail = self.placement.placed(moved, self.tree)
        else:
            motion = self.tree.motion(self.fixed_frame, given.frame_id, given.stamp_ns)
            moved = boxes_to_frame(given, T_fixed_item, self.fixed_frame, motion, ticket)
            self._tracker.max_gap = self.config.max_gap  # which may change
            if self._id_check is None or self.replaces_ids or self._lacks_ids(moved):
                moved = self._tracker.identify(moved)
            else:
                self._id_check.add(moved)
        self._checks.add(given, moved, T_fixed_item, self.sensor_frame, self._tracker)
        return item._replace(moved=moved, T_fixed_item=T_fixed_item, reason=reason, detail=detail)

    def _lacks_ids(self, boxes: BoxArray) -> bool:
        """Return whether boxes are associated, since none has had an id so far."""
        self._has_ids |= any(boxes.track_ids)
        is_assigned = self.assigns_ids and not self._has_ids and bool(boxes.track_ids)
        self._has_assigned |= is_assigned
        return is_assigned

    def _name_odometry_child(self) -> None:
        """Take odometry without a child frame for that of the vehicle, if no motion is known."""
        tree, frame = self.tree, self.sensor_frame
        if tree.lacks_odometry_child and frame and tree.fixed_frame(frame) is None:
            tree.name_odometry_child(frame)
            self._odometry_lacks_child = True

    def merged(self, sweep: Sweep, extra: object = None) -> list[MergedSweep]:
        """
        Return the sweeps that a cloud completes: itself for a single topic.

        Parameters
        ----------
        sweep : Sweep
            A cloud in the fixed frame, with its topic if there are several.
        extra : object
            Returned with the sweep that the cloud is part of.

        Returns
        -------
        list of MergedSweep
            In the order of their stamps; empty while clouds of other LiDARs are waited for.

        """
        if self._merger is None:
            return [MergedSweep(sweep, (extra,))]
        if sweep.topic in self._checks.other_clocks:
            return self._merger.leave_out(sweep)
        return self._merger.add(sweep, extra)

    @property
    def lidar_counts(self) -> dict[str, Counter[str]]:
        """Return for each of several topics of clouds how many were merged, late or missing."""
        return {} if self._merger is None else self._merger.counts

    def unmerged(self) -> list[MergedSweep]:
        """Return the sweeps that wait for clouds of other LiDARs, without waiting on."""
        return [] if self._merger is None else self._merger.flush()

    def require_fixed_frame(self, item: Sweep | BoxArray) -> str:
        """
        Return the fixed frame; choose it among the known transforms if it is not known yet.

        Parameters
        ----------
        item : Sweep or BoxArray
            In the frame of its message. A sweep chooses by its own frame, boxes by `sensor_frame`.

        Returns
        -------
        fixed_frame : str
            The same from then on.

        Raises
        ------
        TransformUnavailable
            If no motion of the frame of the clouds is known, no cloud has arrived, or the clouds
            have no frame.

        """
        lacks_frame = isinstance(item, Sweep) and not item.frame_id
        self._has_clouds_without_frame |= lacks_frame
        if lacks_frame:
            raise TransformUnavailable(CLOUDS_WITHOUT_FRAME)
        if self.fixed_frame:
            return self.fixed_frame
        sensor_frame = item.frame_id if isinstance(item, Sweep) else self.sensor_frame
        if not sensor_frame and self._has_clouds_without_frame:
            raise TransformUnavailable(CLOUDS_WITHOUT_FRAME)
        if not sensor_frame:
            raise TransformUnavailable(
                f'no point cloud has arrived, so the motion of the boxes in {item.frame_id!r} is '
                f'not known; check the topic of the clouds and its QoS'
            )
        found = self.tree.fixed_frame(sensor_frame)
        if found is None:
            is_alone = sensor_frame not in self.tree.frames() and bool(self.tree.edges())
            connect = 'publish its place in one of these on /tf_static; ' if is_alone else ''
            raise TransformUnavailable(
                f'neither /tf nor odometry has the motion of the frame of the clouds '
                f'{sensor_frame!r}; known: {self.tree}; {connect}if it does not move, set '
                f'fixed_frame:={self.tree.root(sensor_frame)}'
            )
        self.fixed_frame = found
        return found

    @property
    def fixed_frame_jumps(self) -> bool:
        """Return whether to `change_fixed_frame`: all that is held is in the one that jumps."""
        may_change = self.leaves_frames_that_jump and self._chooses_frame
        return may_change and bool(self._checks.smooth_frame)

    def change_fixed_frame(self) -> None:
        """Choose the frame below the fixed one that moves smoothly."""
        self.left_frame = self.left_frame or self.fixed_frame
        self.fixed_frame = self._checks.give_way(self.fixed_frame)

    @property
    def findings(self) -> list[Finding]:
        """Return the faults of the input, and guesses about it, that were found so far."""
        same = ', '.join(f'{a!r} and {b!r}' for a, b in sorted(self.tree.same_frames.items()))
        odometry = f'odometry: {self.tree.odometry_note}' if self._odometry_lacks_child else ''
        remedy = REPLACED_IDS if self.replaces_ids else ASSOCIATE
        texts = [
            *((Reason.POINT_TIMES, text) for text in self.placement.normalised.values()),
            (Reason.TRANSFORM_FAULT, same and SAME_FRAMES.format(same)),
            (Reason.TRANSFORM_FAULT, self._boxes_without_frame),
            (Reason.TRANSFORM_FAULT, odometry),
            (Reason.TRACK_IDS_JUMP, BOXES_WITHOUT_IDS if self._has_assigned else ''),
            (Reason.TRACK_IDS_JUMP, self.jumping_ids and f'{self.jumping_ids}; {remedy}'),
        ]
        found = [Finding(reason, text) for reason, text in texts if text]
        return [*self._checks.findings(not self.jumping_ids), *found]

    @property
    def replaces_ids(self) -> bool:
        """Return whether boxes are associated from here on, as ids identify no objects."""
        return self.assigns_ids and self._id_check is not None and self._id_check.is_certain

    @property
    def jumping_ids(self) -> str:
        """Return that ids of the input do not identify objects; empty if they do."""
        if self._id_check is None or self.trusts_ids:
            return ''
        return self._id_check.finding

    @property
    def finding(self) -> str:
        """Return all findings in one line; empty if there are none."""
        return '; '.join(found.text for found in self.findings)

    @property
    def facts(self) -> dict[str, object]:
        """Return the origin of the ids, for reports."""
        is_assigned = self._id_check is None or self._has_assigned or self.replaces_ids
        if not is_assigned:
            return {'ids': 'of the input'}
        return {'ids': 'by association', 'associated_tracks': self._tracker.count}


def hand_to_registrar(
    registrar: BoxRegistrar, moved: Sweep | BoxArray | None, restarts: bool, reason: str = ''
) -> list[RefinedBoxes]:
    """
    Hand a sweep or boxes to the registrar; return results that are ready now.

    Parameters
    ----------
    registrar : BoxRegistrar
        Takes them.
    moved : Sweep, BoxArray or None
        In the fixed frame; None if there is nothing to hand over.
    restarts : bool
        Whether time went back before it: tracks are flushed and the registrar is reset first.
    reason : str
        Why boxes are kept; empty for boxes to refine.

    Returns
    -------
    list of RefinedBoxes
        In the fixed frame, in the order of `BoxRegistrar`.

    Raises
    ------
    ShapeError
        If boxes and their sweep are in different frames.

    """
    ready: list[RefinedBoxes] = []
    if restarts:
        ready += registrar.flush()
        registrar.reset()
    if isinstance(moved, Sweep):
        ready += registrar.add_sweep(moved)
    elif moved is not None and reason:
        ready += registrar.add_kept(moved, reason)
    elif moved is not None:
        ready += registrar.add_boxes(moved)
    return ready


def is_placeholder(item: Sweep | BoxArray) -> bool:
    """Return whether this is an array without boxes that has no stamp or no frame either."""
    is_empty = isinstance(item, BoxArray) and not item.track_ids
    return is_empty and not (item.frame_id and item.stamp_ns)


def refined_to_frame(refined: RefinedBoxes, T_frame_boxes: Floats, frame_id: str) -> RefinedBoxes:
    """
    Return refined boxes and their covariances in another frame.

    Parameters
    ----------
    refined : RefinedBoxes
        In any frame.
    T_frame_boxes : array, shape (4, 4)
        Maps their frame to the other one, at their stamp.
    frame_id : str
        The other frame; if it is theirs, `refined` is returned.

    Returns
    -------
    refined : RefinedBoxes
        Boxes as of `boxes_to_frame`, covariances as of `turned_covariances`; those of the extents
        are the same in any frame.

    """
    if frame_id == refined.boxes.frame_id:
        return refined
    return replace(
        refined,
        boxes=boxes_to_frame(refined.boxes, T_frame_boxes, frame_id),
        covariances=turned_covariances(refined.covariances, T_frame_boxes),
    )


def covariances_to_write(refined: RefinedBoxes) -> Floats:
    """Return covariances (n, 6, 6) for messages; NaN where kept: those of the detector remain."""
    is_kept = np.array([status == KEPT for status in refined.status], dtype=bool)
    return np.where(is_kept[:, None, None], np.nan, refined.covariances)
