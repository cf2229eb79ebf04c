"""All checks of an input together: which sees what of a message, and which finding counts."""

from __future__ import annotations

from collections.abc import Set
from functools import partial

from boxreg_ros.config import Config
from boxreg_ros.io.checks.axis import AxisCheck
from boxreg_ros.io.checks.cloud import CloudCheck
from boxreg_ros.io.checks.common_motion import CommonMotionCheck
from boxreg_ros.io.checks.finding import Finding
from boxreg_ros.io.checks.motion import MotionCheck
from boxreg_ros.io.checks.motion_time import MotionTimeCheck
from boxreg_ros.io.checks.place import PlaceCheck
from boxreg_ros.io.checks.pose import PoseCheck
from boxreg_ros.io.checks.stamps import StampCheck
from boxreg_ros.io.checks.twice import RepeatCheck, TwiceCheck
from boxreg_ros.io.checks.unit import UnitCheck
from boxreg_ros.io.id_assignment import Tracker
from boxreg_ros.io.lidars import Lidars
from boxreg_ros.io.transform_tree import TransformTree
from boxreg_ros.reasons import Reason
from boxreg_ros.structures import BoxArray, Floats, Sweep
from msg_adapters.convention import Convention
import numpy as np


class InputChecks:
    """
    The checks of clouds, boxes and the motion of the sensors.

    Boxes are read by the `convention` that is checked; `tree` is read only.

    """

    def __init__(
        self, convention: Convention, config: Config, tree: TransformTree, lidars: Lidars
    ) -> None:
        self._convention = convention
        self._tree = tree
        self._cloud = CloudCheck(is_merged=len(lidars.topics) > 1)
        named_sensors = bool(lidars.frames or lidars.info)
        self._motion = MotionCheck(tree, named_sensors, convention.boxes_offset)
        self._axis = AxisCheck(convention, config.drives)
        self._common_motion = CommonMotionCheck()
        self._twice = TwiceCheck(config)
        self._repeat = RepeatCheck()
        self._stamps: dict[str, StampCheck] = {}  # by topic of clouds
        self.restart()

    @property
    def other_clocks(self) -> Set[str]:
        """Return the topics of LiDARs whose clock differs from those of others and the motion."""
        return self._motion.other_clocks

    @property
    def smooth_frame(self) -> str:
        """Return the frame that a fixed frame which jumps could give way to; empty if none."""
        return self._motion.smooth_frame

    def give_way(self, fixed_frame: str) -> str:
        """Return the smooth frame, which is used from here on in place of one that jumps."""
        return self._motion.give_way(fixed_frame)

    def restart(self) -> None:
        """Forget what a time jump parts."""
        self._pose = PoseCheck(self._convention)
        self._place = PlaceCheck(self._convention)
        self._unit = UnitCheck()
        self._motion_time = MotionTimeCheck()
        for check in (self._motion, self._axis, self._common_motion):
            check.forget()

    def add_received(
        self, given: Sweep | BoxArray, fixed_frame: str, received_ns: int | None
    ) -> None:
        """Add the content of a message when it is received, by the clock of the transforms."""
        self._motion.add(given, fixed_frame, received_ns)

    def add(
        self,
        given: Sweep | BoxArray,
        moved: Sweep | BoxArray,
        T_fixed_item: Floats,
        sensor_frame: str,
        tracker: Tracker,
    ) -> None:
        """
        Add the content of a message of which the motion is known.

        Parameters
        ----------
        given : Sweep or BoxArray
            In the frame of the message.
        moved : Sweep or BoxArray
            In the fixed frame, boxes with their ids.
        T_fixed_item : array, shape (4, 4)
            Pose of the one frame in the other.
        sensor_frame : str
            That of the clouds; empty before one has arrived.
        tracker : Tracker
            The objects up to these boxes, by their motion alone.

        """
        fixed_frame = moved.frame_id
        pose_of_sensor = partial(self._tree.find, fixed_frame, sensor_frame)
        if isinstance(given, BoxArray):
            self._repeat.add(given)
        else:
            self._cloud.add(given)
            self._motion.add_pose(given, fixed_frame, T_fixed_item)
            stamps = self._stamps.setdefault(given.topic, StampCheck())
            stamps.add(given, T_fixed_item[:3, 3])
        self._unit.add(moved, T_fixed_item)
        self._pose.add(moved)
        self._place.add(moved, T_fixed_item, self._other_frames(given, fixed_frame, sensor_frame))
        if isinstance(moved, BoxArray):
            self._twice.add(moved)
            if sensor_frame:
                route = self._tree.route(fixed_frame, sensor_frame)
                self._common_motion.add(moved.stamp_ns, tracker, route, pose_of_sensor)
            self._axis.add(moved, float(np.arctan2(T_fixed_item[1, 0], T_fixed_item[0, 0])))
        if isinstance(given, Sweep) or not self._is_carried(given.frame_id, sensor_frame):
            self._motion_time.add(moved, pose_of_sensor, sensor_frame, self._tree.clock_offset)

    def _is_carried(self, frame: str, sensor_frame: str) -> bool:
        """Return whether a frame is fixed to that of the clouds, which may not move either."""
        return all(map(self._tree.is_constant, self._tree.route(frame, sensor_frame)))

    def _other_frames(
        self, given: Sweep | BoxArray, fixed_frame: str, sensor_frame: str
    ) -> dict[str, Floats]:
        """Return the poses of the frames that boxes may be in, beside that of their message."""
        found: dict[str, Floats] = {}
        if isinstance(given, Sweep) or not self._place.is_open:
            return found
        route = self._tree.route(fixed_frame, sensor_frame or given.frame_id)
        names = {name for edge in route for name in (edge.parent, edge.child)}
        for name in sorted(names - {given.frame_id}):
            pose = self._tree.find(fixed_frame, name, given.stamp_ns)
            if pose is not None:
                found[name] = pose
        return found

    def findings(self, ids_identify: bool) -> list[Finding]:
        """Return what was found so far; ways of objects count where ids identify these."""
        # Points show which horizontal extent is which, motion also which axis points forward;
        # boxes in another place show neither.
        of_ways = (self._axis.class_finding or self._axis.finding) if ids_identify else ''
        of_classes = '' if self._axis.is_turned else self._pose.class_finding
        of_axes = of_classes or of_ways or self._pose.finding
        found = self._unit.finding or self._place.finding or of_axes
        poses = found or self._place.flat or self._place.unturned
        known = self._motion.findings.copy()
        of_stamps = [one.finding for one in self._stamps.values() if one.finding]
        if of_stamps:
            known.pop('jitter', None)  # odometry of these clouds has their stamps
        texts = [
            *((Reason.CLOCK_OFFSET, text) for text in of_stamps),
            *((Reason.CLOUD_FAULT, text) for text in self._cloud.findings),
            (Reason.TRANSFORM_FAULT, self._common_motion.finding),
            (Reason.CLOCK_OFFSET, '' if 'clock' in known else self._motion_time.finding),
            (Reason.TRANSFORM_FAULT, self._place.fallen),
            (Reason.POSE_REFERENCE, poses),
            (Reason.OBJECTS_TWICE, self._twice.finding),
            (Reason.BOXES_REPEATED, self._repeat.finding),
        ]
        return [*known.values(), *(Finding(reason, text) for reason, text in texts if text)]
