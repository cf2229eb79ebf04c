"""
`measure labeller`: actions of a labeller until a drive with planted errors is right.

The sample street gets 20 wrong boxes, 5 ghosts, 3 broken and 2 swapped tracks, and 3 objects lose
their boxes. `boxreg relabel --complete` runs, and a script reviews the result in a headless
Chromium, by the mouse and the keys of a person. It knows the true boxes, as a person sees the
points. Beside its actions are those of the page of the first release, which could neither delete,
split, join nor add: there, files are edited by hand.

Then the drive loses all boxes: the script labels whole tracks, by the objects that the run
proposes, and by boxes that it draws.

"""

from collections import Counter
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
import time

from boxreg_ros.core.metrics import iou_3d
from boxreg_ros.io.box_table import BoxTable
from boxreg_ros.io.fixed_frame import input_boxes
from boxreg_ros.io.recording import Recording
from boxreg_ros.offline.review_command import drive_of
from boxreg_ros.review.decisions import DECISIONS, held, read_decisions
from boxreg_ros.review.server import review_server
from boxreg_ros.structures import BoxArray, REJECTED, YAW
from browser import end_shared_browser, opened_page, serving
from measure.common import BOXREG
import numpy as np

STREET = Path(__file__).parents[2] / 'bags'
WRONG, GHOSTS, BROKEN, SWAPPED, MISSING = 20, 5, 3, 2, 3
RUN = 5
"""Wrong boxes that follow each other."""
RIGHT = 0.5
"""3D IoU with the true box from which on a box is right; chosen: anyone sees a smaller one."""
SEEN = 0.6
"""The labeller corrects boxes below this one: what a run changes again leaves them right."""
MIN_POINTS = 20
"""Objects with fewer points, by the median, get no errors and are not judged."""
SECONDS = {'key': 0.28, 'click': 1.3, 'drag': 2.5}
"""Of the keystroke-level model: a key; pointing and a click; pointing, a press, pointing [s]."""
TIMEOUT = 120_000
"""Of the page, on a loaded machine [ms]."""
MIN_DRAWN_POINTS = 5
"""True boxes with fewer points need not be in a whole track."""
WHOLE = 0.9
"""Part of the true boxes with points that a whole track has."""
TRACKS = 20
"""To label in a drive without boxes."""
OFFERED = 0.75
"""A proposed box with a smaller 3D IoU is drawn again."""
CLASSES = ('car', 'van', 'truck', 'cyclist', 'pedestrian')
THINKING = 1.35
"""Of the same model, before each decision [s]."""
BEFORE = {
    'wrong': ('open', 'step', 'e', 'drag', 'drag', 'Enter', 'next'),
    'ghost': ('open', 'read id', 'editor', 'search', 'select rows', 'delete', 'save'),
    'broken': ('open', 'read id', 'open', 'read id', 'editor', 'replace', 'type', 'type',
               'save'),
    'swapped': ('open', 'step', 'read stamp', 'open', 'read id', 'editor', 'search', 'select',
                'replace', 'type', 'search', 'select', 'replace', 'type', 'save'),
    'missing': ('another tool', 'open', 'step', 'draw', 'class', 'id', 'keyframe', 'keyframe',
                'export', 'merge'),
    'right': ('a', 'next'),
    'apply': ('terminal', 'command', 'Enter'),
}  # fmt: skip
"""What one error of each kind took in the page of the first release and in a text editor."""
ARGUMENTS = {'--seed': (0, '')}


def run(args):
    """Plant, relabel, review, and return actions and errors."""
    with TemporaryDirectory() as folder:
        return measure(Path(folder), args.seed)


def measure(folder, seed=0):
    """Return the errors that were planted, left by the run and by the review, and its actions."""
    truth = BoxTable.read(STREET / 'street_truth.csv')
    given = planted(truth, seed)
    given.write(folder / 'planted.csv')
    out = folder / 'out'
    labels = f'csv:{folder / "planted.csv"}'
    command = ['relabel', str(STREET / 'street.mcap'), '-o', str(out), '--report']
    command += ['--labels', labels, '--formats', 'csv', '--complete']
    subprocess.run([*BOXREG, *command], stdout=subprocess.DEVNULL, check=True)
    begin = time.perf_counter()
    labeller = reviewed(out, truth)
    seconds = time.perf_counter() - begin
    first, last = (
        errors(BoxTable.read(one / 'boxes.csv'), truth)
        for one in (out, out.with_name('out.corrected'))
    )
    before = sum(first[kind] * len(BEFORE[kind]) for kind in first)
    right = labeller.decided['right'] * len(BEFORE['right'])
    return {
        'planted': errors(given, truth),
        'relabelled': first,
        'reviewed': last,
        'actions': labeller.actions.total(),
        'kinds': dict(labeller.actions),
        'decisions': dict(labeller.decided),
        'actions_before': before + right + len(BEFORE['apply']),
        'seconds': labeller.seconds,
        'thinking': THINKING * labeller.decided.total(),
        'script_seconds': seconds,
        'broken_decisions': broken_decisions(out.with_name('out.corrected')),
        'from_nothing': from_nothing(folder, truth),
    }


def from_nothing(folder, truth):
    """Label the drive without its boxes; return actions, and the whole tracks with their IoU."""
    out = folder / 'nothing'
    command = ['relabel', str(STREET / 'street.mcap'), '-o', str(out), '--report']
    command += ['--boxes', 'none', '--proposals', '--formats', 'csv']
    subprocess.run([*BOXREG, *command], stdout=subprocess.DEVNULL, check=True)
    labeller = reviewed(out, truth, with_boxes=False)
    written = out.with_name('nothing.corrected')
    ious, whole = whole_tracks(BoxTable.read(written / 'boxes.csv'), truth)
    return {
        'actions': labeller.actions.total(),
        'kinds': dict(labeller.actions),
        'decisions': dict(labeller.decided),
        'tracks': len(ious),
        'whole': len(whole),
        'iou': float(np.mean(list(ious.values()))),
        'least_iou': min(ious.values()),
        'broken_decisions': broken_decisions(written),
    }


def whole_tracks(table, truth):
    """Return the mean 3D IoU of the boxes of each track by object, and which tracks are whole."""
    matches = Matches(truth)
    ids = np.array(truth.track_ids)
    ious = {}
    whole = set()
    for name in set(table.track_ids):
        rows = np.flatnonzero(np.array(table.track_ids) == name)
        near = matches.of_track(table.stamps_ns[rows].tolist(), table.boxes[rows])
        owner = Counter(one for one, _, _ in near).most_common(1)[0][0]
        wanted = (ids == owner) & (truth.num_points >= MIN_DRAWN_POINTS)
        has_box = wanted & np.isin(truth.stamps_ns, table.stamps_ns[rows])
        if not owner:
            continue
        ious[owner] = float(np.mean([overlap for _, overlap, _ in near]))
        if has_box.sum() >= WHOLE * wanted.sum():
            whole.add(owner)
    return ious, whole


def broken_decisions(out):
    """Return how many boxes of a result are not as decided, of how many that were decided."""
    table = BoxTable.read(out / 'boxes.csv')
    keys = zip(table.track_ids, table.stamps_ns.tolist(), strict=True)
    row_of = {key: row for row, key in enumerate(keys)}
    decisions = held(read_decisions(out / DECISIONS))
    stamps = {stamp for _, stamp in row_of}
    new_id = {
        (one.track_id, stamp): one.value
        for one in decisions if one.kind == 'rename'
        for stamp in stamps if one.covers(stamp)
    }  # fmt: skip
    broken = total = 0
    for one in decisions:
        if one.box is not None:
            key = new_id.get((one.track_id, one.stamp_ns), one.track_id), one.stamp_ns
            row = row_of.get(key, -1)
            total += 1
            broken += row < 0 or not np.allclose(table.boxes[row, :6], one.box[:6], atol=1e-6)
        for (name, stamp), row in row_of.items():
            if name != new_id.get((one.track_id, stamp), one.track_id) or not one.covers(stamp):
                continue
            is_label = table.status[row] != REJECTED
            is_broken = {
                'delete': is_label,
                'accept': not is_label,
                'reclass': table.class_names[row] != one.value,
            }
            total += one.kind in is_broken
            broken += is_broken.get(one.kind, False)
    return {'broken': int(broken), 'boxes': total}


def judged(truth):
    """Return the objects that get errors and are judged: those with points, the most first."""
    names = np.array(truth.track_ids)
    points = {
        name: float(np.median(truth.num_points[names == name])) for name in set(truth.track_ids)
    }
    return sorted((n for n in points if points[n] >= MIN_POINTS), key=lambda n: (-points[n], n))


def planted(truth, seed):
    """Return the boxes of the detector of the street, with errors."""
    rng = np.random.default_rng(seed)
    arrays, _ = input_boxes(Recording([STREET / 'street.mcap']))
    table = BoxTable.from_arrays(arrays)
    names = np.array(table.track_ids, object)
    boxes = table.boxes.copy()
    order = iter(rng.permutation(judged(truth)).tolist())
    stamps = np.unique(table.stamps_ns)
    middle = stamps[len(stamps) // 2]
    is_late = table.stamps_ns >= middle
    keep = np.ones(len(names), bool)
    for _ in range(MISSING):
        keep &= names != next(order)
    for number in range(BROKEN):
        names[is_late & (names == next(order))] = str(101 + number)
    first, second = next(order), next(order)
    assert SWAPPED == 2
    late = [is_late & (names == one) for one in (first, second)]
    names[late[0]], names[late[1]] = second, first
    for _ in range(WRONG // RUN):
        rows = np.flatnonzero(names == next(order))
        begin = int(rng.integers(0, len(rows) - RUN))
        part = rows[begin : begin + RUN]
        sign = rng.choice([-1.0, 1.0])
        boxes[part, :2] += sign * rng.uniform(0.4, 0.5, 2) * boxes[part, 3:4].clip(3.6)
        boxes[part, YAW] += sign * 0.4
    table = replace(table, track_ids=tuple(names), boxes=boxes).rows(keep)
    return _with_ghosts(table, truth, rng)


def _with_ghosts(table, truth, rng):
    """Return a table with boxes at places where no object ever is."""
    stamps = np.unique(table.stamps_ns)
    low, high = truth.boxes[:, :2].min(0), truth.boxes[:, :2].max(0)
    places = []
    while len(places) < GHOSTS:
        place = rng.uniform(low, high)
        taken = np.concatenate([truth.boxes[:, :2], np.array(places).reshape(-1, 2)])
        if np.linalg.norm(taken - place, axis=1).min() > 5:
            places.append(place)
    ghosts = []
    for place in places:
        box = np.array([*place, 0.8, 4.4, 1.8, 1.6, 0, 0, rng.uniform(-3, 3)])
        ghosts.append(box + rng.normal(0, 0.05, (len(stamps), 9)) * [1, 1, *[0] * 6, 0.1])
    names = tuple(str(201 + number) for number in range(GHOSTS))
    arrays = []
    for step, stamp_ns in enumerate(stamps.tolist()):
        here = table.rows(table.stamps_ns == stamp_ns)
        arrays.append(BoxArray(
            stamp_ns, table.frame_id, here.track_ids + names,
            here.class_names + ('car',) * GHOSTS, np.r_[here.scores, np.ones(GHOSTS)],
            np.concatenate([here.boxes, np.array(ghosts)[:, step]]),
        ))  # fmt: skip
    return BoxTable.from_arrays(arrays)


class Matches:
    """The true boxes by stamp, and the object that each box is nearest to."""

    def __init__(self, truth):
        self._truth = truth
        self._rows = {
            int(stamp): np.flatnonzero(truth.stamps_ns == stamp)
            for stamp in np.unique(truth.stamps_ns)
        }
        self.judged = set(judged(truth))

    def of(self, stamp_ns, box):
        """Return the nearest object, the 3D IoU with it, and its true box."""
        rows = self._rows[stamp_ns]
        boxes = self._truth.boxes[rows]
        nearest = int(np.linalg.norm(boxes[:, :2] - box[:2], axis=1).argmin())
        if np.linalg.norm(boxes[nearest, :2] - box[:2]) > 4:
            return '', 0.0, boxes[nearest]
        overlap = float(iou_3d(box[None], boxes[nearest : nearest + 1])[0])
        return self._truth.track_ids[rows[nearest]], overlap, boxes[nearest]

    def truth_of(self, names, stamp_ns, box):
        """Return the largest 3D IoU with some objects, and that true box; 1 if none is there."""
        rows = [row for row in self._rows[stamp_ns] if self._truth.track_ids[row] in names]
        boxes = self._truth.boxes[rows]
        overlaps = iou_3d(np.repeat(box[None], len(rows), 0), boxes)
        best = int(overlaps.argmax()) if rows else -1
        return (float(overlaps[best]), boxes[best]) if rows else (1.0, box)

    def of_track(self, stamps_ns, boxes):
        """Return the same of each box of a track."""
        return [self.of(stamp, box) for stamp, box in zip(stamps_ns, boxes, strict=True)]


def errors(table, truth):
    """Return the wrong boxes, ghosts, broken and swapped tracks, and missing objects of labels."""
    matches = Matches(truth)
    tracks = {}
    for row, name in enumerate(table.track_ids):
        if table.status[row] != REJECTED:
            tracks.setdefault(name, []).append(row)
    found = Counter(wrong=0, ghost=0, broken=0, swapped=0, missing=0)
    owners = {}
    for name, rows in tracks.items():
        near = matches.of_track(table.stamps_ns[rows].tolist(), table.boxes[rows])
        objects = Counter(one for one, _, _ in near if one)
        if objects.total() < len(rows) / 2:
            found['ghost'] += 1
            continue
        main = {one for one, count in objects.items() if count > len(rows) / 4}
        found['swapped'] += len(main) > 1
        for one in main & matches.judged:
            owners.setdefault(one, set()).add(name)
        for row in rows if main & matches.judged else ():
            overlap, _ = matches.truth_of(main, int(table.stamps_ns[row]), table.boxes[row])
            found['wrong'] += overlap < RIGHT
    names = {name for name in owners if len(owners[name]) > 1}
    found['broken'] = len([n for n in names if all(_is_pure(table, tracks[t], matches)
                                                   for t in owners[n])])  # fmt: skip
    found['missing'] = len(matches.judged - owners.keys())
    return dict(found)


def _is_pure(table, rows, matches):
    near = matches.of_track(table.stamps_ns[rows].tolist(), table.boxes[rows])
    objects = Counter(one for one, _, _ in near if one)
    return sum(count > len(rows) / 4 for count in objects.values()) == 1


class Labeller:
    """A person at the page, who sees what is wrong and acts by mouse and keys."""

    def __init__(self, page, truth):
        self._page = page
        page.set_default_timeout(TIMEOUT)
        self._matches = Matches(truth)
        self._truth = truth
        self.actions = Counter()  # keys, clicks and drags
        self.decided = Counter()  # decisions by the kind of error

    @property
    def seconds(self):
        """Return the time that a person needs [s]."""
        acting = sum(SECONDS[kind] * count for kind, count in self.actions.items())
        return acting + THINKING * self.decided.total()

    def key(self, name):
        """Press a key."""
        self.actions['key'] += 1
        self._page.keyboard.press(name)

    def click(self, selector):
        """Click an element."""
        self.actions['click'] += 1
        self._page.click(selector)

    def click_slider(self, selector, row, last):
        """Click a slider at one of its rows."""
        self.actions['click'] += 1
        bounds = self._page.locator(selector).bounding_box()
        x = bounds['x'] + 8 + (bounds['width'] - 16) * row / max(1, last)
        self._page.mouse.click(x, bounds['y'] + bounds['height'] / 2)

    def review(self):
        """Look at every track, then at what is broken, then at what is missing."""
        self.click('#tab-tracks')
        self._page.wait_for_function('view.part')
        seen = set()
        while True:
            name = self._page.evaluate('current().id')
            if name in seen:
                break
            seen.add(name)
            self._look()
        self._join()
        self._add()
        self._save()

    def label(self):
        """Label a drive without boxes: what is proposed, then the objects with the most points."""
        self._page.wait_for_function('scene.sweep', timeout=TIMEOUT)
        labelled = self._take_proposals()
        ids = np.array(self._truth.track_ids)
        most = {name: int(self._truth.num_points[ids == name].max()) for name in set(ids)}
        left = sorted(most.keys() - labelled, key=most.get, reverse=True)
        for name in left[: TRACKS - len(labelled)]:
            if self._page.evaluate('$("drive").hidden'):
                self.key('i')
                self._page.wait_for_function('scene.isAdding && !$("drive").hidden')
            rows = np.flatnonzero(ids == name)
            self._draw(self._truth.boxes[self._row_to_draw(rows)])
            self._keep('drawn')
        self._save()

    def _save(self):
        """Save the decisions, and wait for the run with them."""
        self.key('Control+s')
        self._page.wait_for_function("$('notice').textContent.includes('boxes in')",
                                     timeout=600_000)  # fmt: skip

    def _take_proposals(self):
        """Follow the objects that are proposed; return their names."""
        labelled = set()
        seen = set()
        while self._page.evaluate('openProposals().length'):
            self._page.evaluate('scene.fit = null')
            self.key('p')
            self._page.wait_for_function('scene.fit && !$("drive").hidden')
            self._page.wait_for_timeout(300)
            stamp, box = self._page.evaluate('[scene.fit.stamp, scene.fit.box]')
            if (stamp, str(box)) in seen:
                break
            seen.add((stamp, str(box)))
            name, overlap, true_box = self._matches.of(int(stamp), np.array(box))
            if not name or name in labelled:
                continue
            if overlap < OFFERED:
                self._draw(true_box)
            self._keep('drawn again' if overlap < OFFERED else 'proposed')
            labelled.add(name)
        return labelled

    def _row_to_draw(self, rows):
        """Return the row of the truth to draw: of the sweep that is shown, if it serves."""
        points = self._truth.num_points[rows]
        stamps = self._page.evaluate('DATA.stamps')
        shown = self._truth.stamps_ns[rows] == int(stamps[self._page.evaluate('scene.at')])
        if shown.any() and points[shown][0] >= points.max() / 2:
            return rows[shown][0]
        row = rows[int(points.argmax())]
        at = stamps.index(str(self._truth.stamps_ns[row]))
        self.click_slider('#scene-time', at, len(stamps) - 1)
        # A click on the slider may be a sweep off: that one serves as well.
        self._page.wait_for_function('scene.sweep?.stamp === DATA.stamps[scene.at]')
        self._page.wait_for_timeout(300)
        shown_ns = int(self._page.evaluate('DATA.stamps[scene.at]'))
        return rows[int(np.abs(self._truth.stamps_ns[rows] - shown_ns).argmin())]

    def _draw(self, box):
        """Draw a box from its rear to its front, where both are in view."""
        ends = [
            (box[:2] + sign * box[3] / 2 * np.array([np.cos(box[8]), np.sin(box[8])])).tolist()
            for sign in (-1, 1)
        ]
        places = """ends => {
          const bounds = $('scene-view').getBoundingClientRect(), { to } = sceneAxes();
          return ends.map(end => to(end)).map(([x, y]) => [bounds.left + x, bounds.top + y,
            x > 4 && y > 4 && x < bounds.width - 4 && y < bounds.height - 4]); }"""
        for key in ('0', '-', '-', '-', ''):
            found = self._page.evaluate(places, ends)
            if all(is_in_view for *_, is_in_view in found) or not key:
                break
            self.key(key)
        before = self._page.evaluate('scene.fit?.box ?? null')
        is_adding = self._page.evaluate('scene.isAdding')
        self.actions['drag'] += 1
        if not is_adding:
            self._page.keyboard.down('Control')
        self._page.mouse.move(*found[0][:2])
        self._page.mouse.down()
        self._page.mouse.move(*found[1][:2], steps=4)
        self._page.mouse.up()
        if not is_adding:
            self._page.keyboard.up('Control')
        self._page.wait_for_function(
            'before => scene.fit && String(scene.fit.box) !== String(before)', arg=before
        )
        self._page.wait_for_timeout(500)

    def _keep(self, kind):
        """Follow the object that is offered."""
        self.decided[kind] += 1
        count = self._page.evaluate('TRACKS.length')
        self.key('Enter')
        self._page.wait_for_function(
            f"TRACKS.length > {count} && !$('tracks').hidden && view.part && "
            'view.open === TRACKS.at(-1)',
            timeout=TIMEOUT,
        )

    def _look(self):
        """Decide about the open track, and go on with the next one."""
        near = self._matches.of_track(*self._boxes())
        objects = [one for one, _, _ in near]
        if sum(not one for one in objects) > len(near) / 2:
            self._decide('ghost', 'key:d', 'isGone(current())')
            return self._next()
        half = len(near) // 2
        first, last = (Counter(filter(None, part)).most_common(1)
                       for part in (objects[:half], objects[half:]))  # fmt: skip
        if first and last and first[0][0] != last[0][0]:
            row = next(k for k in range(len(near)) if objects[k] == last[0][0])
            self._go(row)
            count = self._page.evaluate('TRACKS.length')
            self._decide('swapped', 'key:s', f'TRACKS.length === {count + 1}')
            self._page.wait_for_timeout(300)
            return None  # the new track is open
        self._correct()
        return self._next()

    def _next(self):
        """Accept and go on, unless the track was deleted."""
        name = self._page.evaluate('current().id')
        if self._page.evaluate('isGone(current())'):
            self.key('ArrowDown')
        else:
            self.decided['right'] += 1
            self.key('Enter')
        with_next = f"current().id !== {name!r} || $('notice').textContent.includes('All tracks')"
        self._page.wait_for_function(with_next)
        self._page.wait_for_timeout(50)

    def _correct(self):
        """Correct boxes of the open track until all that are judged are right."""
        for _ in range(RUN):
            stamps_ns, boxes = self._boxes(with_solved=True)
            near = self._matches.of_track(stamps_ns, boxes)
            main = {Counter(one for one, _, _ in near).most_common(1)[0][0]}
            if not main & self._matches.judged:
                return
            found = [self._matches.truth_of(main, *one)
                     for one in zip(stamps_ns, boxes, strict=True)]  # fmt: skip
            wrong = [k for k, (overlap, _) in enumerate(found) if overlap < SEEN]
            if not wrong:
                return
            row = wrong[len(wrong) // 2]
            self._go(row)
            self.decided['wrong'] += 1
            self.key('e')
            self._drag_to(found[row][1])
            self.key('Enter')
            self._page.wait_for_function('!view.edit && pinOf(view.row)')
            if self._page.evaluate('DATA.tracks[boxAt(view.row)[0]].added'):
                self._page.wait_for_timeout(500)
                continue
            self.key('o')
            self._page.wait_for_function('view.solved')

    def _drag_to(self, target):
        """Drag the stroke at the front of the box, and the box in two views, to a true box."""
        turn, length, heading = self._page.evaluate(
            """target => {
              const by = target[8] - view.edit[8];
              return [Math.atan2(Math.sin(by), Math.cos(by)), view.edit[3],
                      view.edit[8] - view.frame[8]]; }""",
            target.tolist(),
        )
        if abs(turn) > 0.1:
            here, _ = self._off(target)
            tips = [here + 0.58 * length * np.array([np.cos(a), np.sin(a), 0])
                    for a in (heading, heading + turn)]  # fmt: skip
            self._drag('top', *tips)
        for view, axes in (('top', [0, 1]), ('side', [0, 2])):
            here, there = self._off(target)
            if np.abs(there - here)[axes].max() > 0.1:
                self._drag(view, here, there)

    def _off(self, target):
        """Return the centre of the box, and of a true box, in the axes of the views."""
        here, there = self._page.evaluate(
            """target => [view.edit, moved(target, view.part.origin, -1)]
                 .map(box => toFrame(box, view.frame, view.R))""",
            target.tolist(),
        )
        return np.array(here), np.array(there)

    def _drag(self, view, *places):
        """Drag from one place to another one in a view."""
        self.actions['drag'] += 1
        points = self._page.evaluate(
            """([name, places]) => {
              const [right, up] = VIEWS[name], c = $(name), bounds = c.getBoundingClientRect();
              return places.map(place => [
                bounds.left + bounds.width / 2 + c.zoom * (place[right] - view.center[right]),
                bounds.top + bounds.height / 2 - c.zoom * (place[up] - view.center[up])]); }""",
            [view, [place.tolist() for place in places]],
        )
        self._page.mouse.move(*points[0])
        self._page.mouse.down()
        self._page.mouse.move(*points[1], steps=4)
        self._page.mouse.up()
        self._page.wait_for_timeout(50)

    def _join(self):
        """Join the tracks of one object."""
        for name in sorted(self._matches.judged):
            pieces = [one for one, near in self._all().items() if near == name]
            while len(pieces) > 1:
                self._open(pieces[0])
                self.decided['joined'] += 1
                count = self._page.evaluate('TRACKS.length')
                self.key('j')
                self._page.wait_for_selector('#ask[open]')
                shown = self._page.locator('#ask-proposals button').all_inner_texts()
                place = next((k for k, text in enumerate(shown) if text.split()[0] in pieces), -1)
                if place == 0:
                    self.key('Enter')
                elif place > 0:
                    self.click(f'#ask-proposals button:nth-child({place + 1})')
                else:
                    self.click('#ask-text')
                    self._page.fill('#ask-text', pieces[1])
                    self.actions['key'] += len(pieces[1])
                    self.key('Enter')
                self._page.wait_for_function(f'TRACKS.length < {count}')
                pieces = [one for one, near in self._all().items() if near == name]

    def _add(self):
        """Add the objects that have no box."""
        missing = sorted(self._matches.judged - set(self._all().values()))
        names = np.array(self._truth.track_ids)
        for name in missing:
            rows = np.flatnonzero(names == name)
            row = rows[int(self._truth.num_points[rows].argmax())]
            stamp, box = str(self._truth.stamps_ns[row]), self._truth.boxes[row]
            self.decided['missing'] += 1
            self.click('#tab-drive')
            stamps = self._page.evaluate('DATA.stamps')
            at, last = stamps.index(stamp), len(stamps) - 1
            self._page.wait_for_function('scene.sweep')
            self.click_slider('#scene-time', at, last)
            self._page.wait_for_timeout(500)
            self.key('i')
            place = self._page.evaluate(
                """box => {
                  const { points, origin } = scene.sweep, R = rotation(box);
                  const own = [];
                  for (let i = 0; i < points.length; i += 3) {
                    const point = [0, 1, 2].map(k => points[i + k] + origin[k]);
                    const at = toFrame(point, box, R);
                    const isInside = at.every((v, k) => Math.abs(v) < box[3 + k] / 2);
                    if (isInside && at[2] > -box[5] / 5) own.push(point);
                  }
                  const [x, y] = sceneAxes().to(own[own.length >> 1] ?? box);
                  const bounds = $('scene-view').getBoundingClientRect();
                  return [bounds.left + x, bounds.top + y];
                }""",
                box.tolist(),
            )
            self.actions['click'] += 1
            self._page.mouse.click(*place)
            self._page.wait_for_function('scene.fit')
            wanted = self._truth.class_names[row]
            if self._page.evaluate('scene.fit.class') != wanted:
                self.actions['click'] += 2
                self._page.select_option('#scene-class', wanted)
                self._page.wait_for_function(f'scene.fit?.class === {wanted!r}')
                self._page.locator('#scene-view').focus()
            count = self._page.evaluate('TRACKS.length')
            self.key('Enter')
            self._page.wait_for_function(
                f"TRACKS.length > {count} && !$('tracks').hidden && view.part && "
                'view.open === TRACKS.at(-1)',
            )
            self._correct()

    def _open(self, name):
        self.actions['click'] += 1  # on its line
        self._page.evaluate(f'openTrack(TRACKS.findIndex(t => t.id === {name!r}))')
        self._page.wait_for_function(f'view.part && current().id === {name!r}')

    def _go(self, row):
        """Go to a box of the open track by the slider."""
        last = self._page.evaluate('view.part.stamps.length - 1')
        self.click_slider('#time', row, last)
        while self._page.evaluate('view.row') != row:
            self.key('ArrowRight' if self._page.evaluate('view.row') < row else 'ArrowLeft')

    def _boxes(self, with_solved=False):
        """Return stamps and boxes of the open track, as the page shows them."""
        stamps, boxes = self._page.evaluate(
            """isSolved => [view.part.stamps, view.part.usable.map((box, k) => {
              const pin = pinOf(k);
              const solved = isSolved ? view.solved?.get(view.part.stamps[k]) : null;
              return pin?.box ?? solved ?? moved(box, view.part.origin, 1);
            })]""",
            with_solved,
        )
        return list(map(int, stamps)), np.array(boxes)

    def _all(self):
        """Return the object of each track that is not deleted."""
        found = self._page.evaluate(
            """(async () => {
              const tracks = [];
              for (const track of TRACKS.filter(one => !isGone(one))) {
                const part = await loadTrack(track), n = part.usable.length;
                const rows = [n >> 2, n >> 1, (3 * n) >> 2];
                const boxes = rows.map(r => moved(part.usable[r], part.origin, 1));
                tracks.push([track.id, rows.map(r => part.stamps[r]), boxes]);
              }
              return tracks; })()"""
        )
        objects = {}
        for name, stamps, boxes in found:
            near = self._matches.of_track(map(int, stamps), np.array(boxes))
            objects[name] = Counter(one for one, _, _ in near).most_common(1)[0][0]
        return objects

    def _decide(self, kind, action, until):
        self.decided[kind] += 1
        self.key(action.removeprefix('key:'))
        self._page.wait_for_function(until)


def reviewed(out, truth, with_boxes=True):
    """Review a result until it is right, write the labels, and return who did it."""
    classes = () if with_boxes else CLASSES
    with (
        redirect_stdout(sys.stderr),  # the measurement prints one document
        serving(review_server([(out, drive_of(out))], 0, 'script', classes)) as server,
        opened_page(server.address, expected='409') as page,
    ):
        labeller = Labeller(page, truth)
        if with_boxes:
            labeller.review()
        else:
            labeller.label()
    end_shared_browser()
    return labeller
