"""
Refine the sample recording with the node of the launch file.

A test of launch_testing; ``launch_test launch_sample.py params:=FILE`` runs it in a sourced
workspace, with the parameters of a file, and `test_launch.py` without one.

"""

import os
from pathlib import Path
import unittest

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare
import launch_testing
from launch_testing.actions import ReadyToTest
from launch_testing.asserts import assertExitCodes
from paths import BAGS
from ros_graph import first_sweeps, Graph, numbers_changed, play, publishers_for, records_of
from ros_messages import DETECTIONS

SWEEPS = 6


def generate_test_description():
    """Return what a user starts: the launch file, with the topic and the type of the boxes."""
    file = PathJoinSubstitution([FindPackageShare('boxreg_ros'), 'boxreg.launch.xml'])
    arguments = {
        'boxes': '/detections',
        'boxes_type': DETECTIONS,
        'params': LaunchConfiguration('params'),
    }
    include = IncludeLaunchDescription(
        AnyLaunchDescriptionSource(file), launch_arguments=arguments.items()
    )
    return LaunchDescription([DeclareLaunchArgument('params'), include, ReadyToTest()])


class TestSample(unittest.TestCase):
    """While the node runs."""

    def test_boxes_are_refined(self):
        """Play the first sweeps of the sample."""
        records = first_sweeps(records_of(BAGS / 'street.mcap', '/detections'), SWEEPS)
        graph = Graph(Path.cwd(), int(os.environ['ROS_DOMAIN_ID']))
        try:
            publishers_for(graph, records)
            early = graph.collect(DETECTIONS, '/refined_boxes')
            graph.wait_until_connected()
            play(graph, records, early)
        finally:
            graph.close()
        changed = numbers_changed(early, records)
        self.assertEqual(changed[0], 0)
        self.assertGreater(changed[-1], len(early[-1].detections) / 2)


@launch_testing.post_shutdown_test()
class TestEnd(unittest.TestCase):
    """After launch has ended all processes by SIGINT."""

    def test_exit_codes(self, proc_info):
        """All processes have ended with 0."""
        self.assertEqual(len(proc_info.processes()), 1)
        assertExitCodes(proc_info)

    def test_nothing_failed(self, proc_output):
        """The log has no errors."""
        text = b''.join(output.text for output in proc_output).decode()
        self.assertIn("fixed frame is 'odom'", text)
        self.assertNotIn('ERROR', text)
        self.assertNotIn('Traceback', text)
