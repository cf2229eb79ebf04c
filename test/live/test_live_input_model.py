"""What the node has shown of its detector, in a file that the next drive begins with."""

from boxreg_ros.core.input_statistics import from_text
from paths import BAGS
from ros_graph import ended_cleanly, first_sweeps, graph_in, QUICK, records_of

SWEEPS = 12


def test_a_drive_is_added_to_the_file_of_the_drives_before(tmp_path):
    model = tmp_path / 'detector.json'
    records = first_sweeps(records_of(BAGS / 'street.mcap', '/detections'), SWEEPS)
    for part, number in ((records, 1), (records[: len(records) // 2], 2)):
        with graph_in(tmp_path) as graph:
            options = ('-r', 'boxes:=/detections', '-p', f'input_model:={model}')
            node = graph.run(part, *QUICK, *options)
            node.play(part)
            ended_cleanly(node)
        known = f'drives read from {model}: 1' if number == 2 else f'no file {model} yet'
        assert known in node.output()
        drives = from_text(model.read_text(), str(model))
        assert len(drives) == number
        assert all(len(kinds[0].tracks) for kinds in drives.values())
