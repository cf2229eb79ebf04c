#!/usr/bin/env bash
# guess: an executor that leaves a subscription out, by its callback group, sleeps while messages wait there
# happens: if it waits for an event of that subscription, such as lost messages, it wakes again and again without work
# versions: ros-jazzy-rclpy 7.1.6, ros-rmw-fastrtps-cpp 8.4.3 (Fast DDS 2.14.5), Python 3.11
# date: 2026-11-28
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q --disable-pip-version-check 'ros-jazzy-rclpy[fastrtps]==7.1.6' ros-jazzy-common-interfaces==5.3.6
cat > "$folder/run.py" <<'PYTHON'
from importlib.metadata import version
from threading import Event, Thread
import time

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.subscription import Subscription
from std_msgs.msg import String


class LeftOut(CallbackGroup):
    """No subscription of this group is executed; events of it are."""

    def can_execute(self, entity):
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity):
        return self.can_execute(entity)

    def ending_execution(self, entity):
        pass


def seconds_of_cpu(has_events):
    """Return the CPU time that an executor takes in a second in which 300 messages arrive."""
    node = rclpy.create_node('reader')
    events = SubscriptionEventCallbacks(
        message_lost=(lambda _: None) if has_events else None, use_default_callbacks=False
    )
    node.create_subscription(
        String, 'topic', lambda _: None, 1000, callback_group=LeftOut(), event_callbacks=events
    )
    publisher = node.create_publisher(String, 'topic', 1000)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not publisher.get_subscription_count():
        time.sleep(0.05)
    ended = Event()
    spent = []

    def spin():
        begun = time.thread_time()
        while not ended.is_set():
            executor.spin_once(timeout_sec=0.2)
        spent.append(time.thread_time() - begun)

    thread = Thread(target=spin)
    thread.start()
    for _ in range(300):
        publisher.publish(String(data='message'))
        time.sleep(0.003)
    ended.set()
    thread.join()
    executor.shutdown()
    node.destroy_node()
    return spent[0]


rclpy.init(domain_id=93)
without, with_events = seconds_of_cpu(False), seconds_of_cpu(True)
rclpy.shutdown()
for name in ('ros-jazzy-rclpy', 'ros-rmw-fastrtps-cpp', 'ros-fastrtps'):
    print(name, version(name))
print(f'CPU of the executor: {without:.2f} s without events, {with_events:.2f} s with one')
raise SystemExit(0 if with_events > 5 * without else 1)
PYTHON
"$folder/venv/bin/python" "$folder/run.py"
