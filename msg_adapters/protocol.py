"""The protocol of the adapters of box messages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from boxreg_ros.structures import BoxArray, Floats


class Adapter(Protocol):
    """
    Reads boxes from messages of one family, and writes refined boxes into copies of them.

    An adapter is a module with these three functions. It reads messages by attribute and imports
    no message package.

    """

    def from_msg(self, msg: Any) -> BoxArray:
        """
        Return the boxes of a message, in the frame of the message.

        A box whose orientation or numbers are not valid is part of the result with NaN in their
        place: it is an invalid box, which is returned unchanged later.

        Parameters
        ----------
        msg : message
            Of a type of the family, as rclpy, rosbags or mcap decode it. It is not modified.

        Returns
        -------
        boxes : BoxArray
            Of n boxes: `boxes` (n, 9) of centre x y z, length width height [m] and roll pitch yaw
            [rad], in the frame `frame_id`; `stamp_ns` is that of the header, 0 where it has none;
            `track_ids` are '' where the message has none.

        Raises
        ------
        UnsupportedMessage
            If the message lacks a field, contains values of a wrong type, or its parts
            contradict each other.

        """

    def to_msg(
        self,
        msg: Any,
        boxes: BoxArray,
        covariances: Floats | None = None,
        T_out_in: Floats | None = None,
    ) -> Any:
        """
        Return a copy of an input message with its boxes replaced.

        Parameters
        ----------
        msg : message
            The message that `from_msg` has read. It is not modified; fields that are not part of
            a `BoxArray` are copied.
        boxes : BoxArray
            As many boxes, in the same order, in the frame ``boxes.frame_id``. Their kinematics are
            written where they are known and the type has fields for them.
        covariances : array, shape (n, 6, 6), optional
            Covariances of x y z roll pitch yaw [m, rad], written where the type has a field for
            them. Where one is NaN, the covariance of the message remains.
        T_out_in : array, shape (4, 4), optional
            Transform from the frame of the message to that of `boxes`, if they differ. It is
            applied to the copied fields.

        Returns
        -------
        message
            A copy, of the class of `msg`.

        """

    def with_added(self, msg: Any, sources: Sequence[tuple[Any, int]]) -> Any:
        """
        Return a copy of an input message with boxes of earlier messages added behind its own.

        The result is an argument of `to_msg`, which sets the boxes.

        Parameters
        ----------
        msg : message
            The message that `from_msg` has read. It is not modified; it has a stamp.
        sources : sequence of (message, row)
            For each added box an earlier message of the same type, and its row in the
            `BoxArray` of that. All fields are copied but stamp, frame and score: the score is 0,
            because the detector has not found the object.

        Returns
        -------
        message
            A copy, with as many more boxes as there are `sources`, in their order.

        Raises
        ------
        UnsupportedMessage
            If the boxes of `msg` are not of one frame and stamp.

        """
