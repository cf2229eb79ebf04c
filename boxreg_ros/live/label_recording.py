"""Recording of labels while driving: parameters, services and state."""

from __future__ import annotations

from collections.abc import Callable
import os

from boxreg_ros.config import Config
from boxreg_ros.io.label_feed import RecorderSettings, Split
from boxreg_ros.io.markers import text_marker
from boxreg_ros.live.diagnostics import diagnosis, Health
from boxreg_ros.live.inbox import Inbox
from boxreg_ros.live.params import NodeOptions
from boxreg_ros.live.recorder_process import RecorderProcess
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.service import Service
from rclpy.task import Future
from std_srvs.srv import Trigger

MIN_SECONDS_LEFT = 600.0
"""A disk that is full sooner is a WARN in /diagnostics [s]; chosen: time to drive to a stop."""

RECORDING_TIME = 3.0
"""Wait for the last segment of recorded labels [s]. The recorder completes it in any case; launch
files send SIGTERM after 5 s."""


class LabelRecording:
    """
    Start, stop and split the recording of labels. Used by the thread of the executor only.

    While the recording is open the node offers ``~/start_recording``, ``~/stop_recording`` and
    ``~/split``. The inbox passes recorders to the worker, in the order of the messages;
    `settings` returns the present settings.

    """

    def __init__(
        self,
        node: Node,
        inbox: Inbox,
        health: Health,
        settings: Callable[[], tuple[Config, NodeOptions]],
    ) -> None:
        self._node = node
        self._inbox = inbox
        self._health = health
        self._settings = settings
        self._logger: RcutilsLogger = node.get_logger()
        self._recorder: RecorderProcess | None = None
        self._begun = Future()
        self._ended = Future()
        self._error = ''
        self._is_shown = False
        self._services: list[Service] = []

    def offer_services(self) -> None:
        """Create the services."""
        # Their callbacks wait: in the group of the others, these would wait with them.
        group = ReentrantCallbackGroup()
        callbacks = {'start_recording': self._on_start, 'stop_recording': self._on_stop}
        callbacks['split'] = self._on_split
        self._services = [
            self._node.create_service(Trigger, f'~/{name}', callback, callback_group=group)
            for name, callback in callbacks.items()
        ]

    def withdraw_services(self) -> None:
        """Destroy the services."""
        for service in self._services:
            self._node.destroy_service(service)

    def start(self) -> None:
        """Start to record into the folder of the parameter `record_to`."""
        config, options = self._settings()
        settings = RecorderSettings(
            os.path.abspath(os.path.expanduser(options.record_to)), options.record_formats,
            options.record_points, options.record_segment, options.record_camera, config,
        )  # fmt: skip
        self._error = ''
        self._begun = begun = Future()
        self._ended = Future()
        self._recorder = RecorderProcess(
            settings, self._health, lambda: begun.set_result(None), self._note_end, self._recorder
        )
        self._inbox.put_event('record', self._recorder)
        self._logger.info(f'recording labels to {settings.folder}')

    def wait(self, seconds: float) -> bool:
        """Wait until the last segment is whole; return whether it is."""
        return self._recorder is None or self._recorder.has_ended.wait(seconds)

    @property
    def folder(self) -> str:
        """Return the folder of the last recording; '' if there was none."""
        return '' if self._recorder is None else self._recorder.settings.folder

    @property
    def lost(self) -> str:
        """Return the number of items that are lost if the process ends now; '' for none."""
        sizes = {} if self._recorder is None else self._recorder.sizes()
        return ', '.join(f'{size} {name}' for name, size in sizes.items() if size)

    @property
    def text(self) -> str:
        """Return the state in one line; empty while nothing is recorded."""
        if self._error:
            return f'recording stopped: {self._error}'
        if self._recorder is None or self._recorder.has_ended.is_set():
            return ''
        status = self._recorder.status
        name = status.segment or 'waiting for final boxes'
        text = f'recording {name}, {1e-6 * status.rate:.1f} MB/s'
        left = status.seconds_left
        if left is None:
            return text
        remaining = f'{left / 60:.0f} min' if left < 3600 else f'{left / 3600:.1f} h'
        return f'{text}, disk full in {remaining}'

    def show(self, markers: Publisher, frame_id: str) -> None:
        """Publish the state as a text above a sensor; once more to delete it."""
        text = self.text
        if text or self._is_shown:
            markers.publish(text_marker(frame_id, text, bool(self._error)))
        self._is_shown = bool(text)

    def diagnosis(self, name: str) -> DiagnosticStatus:
        """Return the state for /diagnostics, under a name."""
        values: dict[str, object] = {}
        level = DiagnosticStatus.OK
        if self._recorder is not None:
            values = _values_of(self._recorder)
            left = self._recorder.status.seconds_left
            if left is not None and left < MIN_SECONDS_LEFT:
                level = DiagnosticStatus.WARN
        if self._error:
            level = DiagnosticStatus.ERROR
        return diagnosis(name, level, self.text or 'off', values)

    async def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recorder is not None and not self._recorder.has_ended.is_set():
            response.message = (
                f'expected no recording, got one to {self._recorder.settings.folder}; call '
                f'~/stop_recording first'
            )
            return response
        _, options = self._settings()
        if not options.record_to:
            response.message = 'record_to: expected a folder, got none; set this parameter first'
            return response
        self.start()
        await self._begun
        return self._answered(response)

    async def _on_stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recorder is None or self._recorder.has_ended.is_set():
            response.message = 'expected a recording, got none; call ~/start_recording first'
            return response
        self._inbox.put_event('end_recording', None)
        await self._ended
        return self._answered(response)

    def _on_split(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._recorder is None or not self._recorder.is_recording:
            response.message = 'expected a recording, got none; call ~/start_recording first'
            return response
        self._recorder.put(Split())
        response.success = True
        response.message = f'{self._recorder.status.segment or "the segment"} ends'
        return response

    def _answered(self, response: Trigger.Response) -> Trigger.Response:
        """Return a response with the state of the recorder."""
        assert self._recorder is not None
        status = self._recorder.status
        response.success = not self._error
        response.message = self._error or (
            f'{self._recorder.settings.folder}: {status.boxes} boxes in {status.segments} segments'
        )
        return response

    def _note_end(self, error: str) -> None:
        """Note that the recorder has ended; called in a thread of the recorder."""
        self._error = error
        if error:
            self._logger.error(f'recording stopped: {error}')
        self._ended.set_result(None)


def _values_of(recorder: RecorderProcess) -> dict[str, object]:
    """Return the values of a recorder for /diagnostics."""
    status = recorder.status
    left = status.seconds_left
    return {
        'folder': recorder.settings.folder,
        'formats': ', '.join(recorder.settings.formats),
        'segment': status.segment or 'none',
        'segments': status.segments,
        'segments recovered': status.recovered,
        'segments that cannot be read': status.damaged,
        'frames': status.frames,
        'boxes': status.boxes,
        'clouds': status.clouds,
        'frames without cloud': status.without_cloud,
        'boxes left out of formats': status.left_out,
        'written [MB]': f'{1e-6 * status.size:.1f}',
        'rate [MB/s]': f'{1e-6 * status.rate:.2f}',
        'disk free [GB]': f'{1e-9 * status.free:.1f}',
        'disk full in [h]': 'unknown' if left is None else f'{left / 3600:.2f}',
        **recorder.sizes(),
    }
