"""The command `aero-viz live`: the planner on topics of ROS 2, on a sensor, or on a capture that is replayed."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from aero_planner.cli_util import quick_imports
from aero_planner.output_files import check_output_files
from aero_planner.plain_text import say
from aero_viz.cli.flags import ConfigFlags, Inline, OptionalBox, OptionalInt, OptionalPath, OptionalPose, OptionalText
from aero_viz.cli.output import print_report
from aero_viz.cli.serving import WATCHING, PageFlags, announce, serve_others, shutdown_event, wait_for
from aero_viz.errors import UserError
from aero_viz.text_table import format_table

if TYPE_CHECKING:
    import threading
    from collections.abc import Callable

    from aero_viz.live.odometry import OnlineOdometry
    from aero_viz.live.setup import Setup, Wanted
    from aero_viz.live.source import StreamSource
    from aero_viz.live.stream import Stream
    from aero_viz.ros.feed import Feed
    from aero_viz.ros.graph import Topic

_PAGE, _CONFIG = PageFlags(), ConfigFlags()
_ODOMETRIES = ("kiss-icp", "rko-lio")
_DISCOVERY = 10.0
"""Longest time for which topics are waited for [s]."""
_LISTENING = 1.5
"""Time for which topics are listened to before they are chosen and understood [s]."""
_POLL = 0.1
_GOAL_TOPIC = "/goal_pose"
"""Topic of RViz's goals."""


def live(
    *,
    points: OptionalText = None,
    odometry: OptionalText = None,
    goal: Annotated[tuple[str, ...], tyro.conf.arg(metavar="TOPIC|X Y Z")] = (),
    frame: Literal["auto", "body", "world"] = "auto",
    extrinsic: OptionalPose = None,
    mask: OptionalBox = None,
    imu: OptionalText = None,
    livox: OptionalText = None,
    pcap_replay: OptionalPath = None,
    domain: OptionalInt = None,
    rate: float = 20.0,
    keep: float = 180.0,
    record: OptionalPath = None,
    overwrite: bool = False,
    list_topics: Annotated[bool, tyro.conf.arg(name="list")] = False,
    json: bool = False,
    seed: int = 0,
    device: str = "cpu",
    page_flags: Inline[PageFlags] = _PAGE,
    config_flags: Inline[ConfigFlags] = _CONFIG,
) -> None:
    """Plan live on the topics of ROS 2, on a sensor, or on a capture.

    Plans are shown and not flown. Without flags, it lists the graph, takes its clouds and its odometry, and says what
    it assumes about them.

    Args:
        points: Topic of the clouds: PointCloud2, CustomMsg, LaserScan or a depth image. By default it is found.
        odometry: Topic of the poses: Odometry, PoseStamped or TF; or kiss-icp or rko-lio, to estimate them from the
            clouds as they arrive. By default a topic is found.
        goal: Goal [m], or a topic whose positions it follows. By default /goal_pose, and 15 m ahead until one comes.
        frame: What the clouds move with: the body, or the world, as those of FAST-LIO2 do; auto goes by their frame.
        extrinsic: Position [m] and roll, pitch, yaw [deg] of the sensor in the body's frame, instead of those of TF.
        mask: Leave out the points in a box in the body's frame, from its lower to its upper corner [m].
        imu: Topic of the IMU for rko-lio. By default it is found.
        livox: Address of a Livox Mid-360 that sends to this computer, such as 192.168.1.142, or
            192.168.1.142:PORT if it sends its points to another port than 56301; without ROS.
        pcap_replay: Capture of packets, or recording of ROS 2, that is replayed at real speed; without ROS.
        domain: Domain of ROS 2, instead of that of ROS_DOMAIN_ID.
        rate: Plans per second, by default as many as the node makes.
        keep: Time for which the picture can be moved back [s].
        record: MCAP file to write from the start; the page can do so at any time.
        overwrite: Replace an existing file.
        list_topics: List the topics of the graph, and end.
        json: Print the list as one JSON object.
        seed: Seed of the planner's noise.
        device: Warp device of the planner.
        page_flags: The page.
        config_flags: The planner's configuration.
    """
    from aero_viz.live.odometry import TOPIC as ODOMETRY_TOPIC
    from aero_viz.live.setup import Wanted

    page_flags.refuse(besides=WATCHING, advice="the page of a live stream opens no files: leave it out")
    page_flags.check()
    if livox is not None and pcap_replay is not None:
        raise UserError("--livox and --pcap-replay are two sources; give one.")
    if json and not list_topics:
        raise UserError("--json prints the list of topics; add --list.")
    if not 0.1 <= rate <= 200.0 or not keep > 0.0:
        raise UserError(f"--rate is in [0.1, 200] Hz and --keep above 0 s, not {rate:g} and {keep:g}.")
    method = odometry if odometry in _ODOMETRIES else None
    if points is not None and not points.startswith("/"):
        raise UserError(f"--points is a topic, such as /points, not {points!r}.")
    if odometry is not None and method is None and not odometry.startswith("/"):
        raise UserError(f"--odometry is a topic, such as /Odometry, or {' or '.join(_ODOMETRIES)}, not {odometry!r}.")
    if imu is not None and (method != "rko-lio" or not imu.startswith("/")):
        raise UserError(f"--imu is a topic, such as /livox/imu, for --odometry rko-lio, not {imu!r} for {odometry}.")
    place, goal_topic = _goal(goal)
    check_output_files(record, overwrite=overwrite, inputs=[pcap_replay or "", config_flags.config])
    config = config_flags.load()
    wanted = Wanted(points, ODOMETRY_TOPIC if method else odometry, extrinsic, mask, frame)
    with contextlib.ExitStack() as stack:
        if livox is not None or pcap_replay is not None:
            if list_topics or domain is not None:
                raise UserError("--list and --domain are about ROS 2; leave them out without it.")
            stream, feed = _open_desk(stack, livox, pcap_replay), None
        else:
            from aero_viz.live.stream import Stream
            from aero_viz.ros.feed import Feed
            from aero_viz.ros.graph import Graph

            graph = stack.enter_context(Graph("aero_viz_live", domain=domain))
            if list_topics:
                _wait(lambda: graph.topics(), 3.0)
                return print_report(_GraphReport(graph.topics()), as_json=json)
            stream = Stream(f"ROS 2 domain {graph.domain}")
            feed = Feed(graph, stream)
            stack.callback(feed.close)
        shutdown = shutdown_event()
        setup = _understand(stack, stream, feed, wanted, method, imu, goal_topic, shutdown)
        if setup is None:
            return
        with quick_imports():
            from aero_viz.dashboard import Dashboard
            from aero_viz.dashboard.panels.live import LiveOffer
            from aero_viz.live.inspector import Inspector
            from aero_viz.live.session import StreamSession
            from aero_viz.live.source import StreamSource

        options: dict[str, Any] = {"rate": rate, "goal": place, "goal_topic": goal_topic, "kept": keep}
        source = _when_ready(lambda: StreamSource(stream, setup, **options), shutdown)
        if source is None:
            return
        session = StreamSession(source, config=config, device=device, seed=seed)
        stack.callback(session.close)
        if record is not None:
            session.record(record).result()
        dashboard = Dashboard(session, live=LiveOffer(Path.cwd()), **page_flags.server_options)
        stack.callback(dashboard.close)
        serve_others(stack, session, page_flags)
        # Others may look at any time, and online odometry needs every cloud.
        if feed is not None and method is None and page_flags.foxglove_port is None and not page_flags.ros_out:
            session.rest_unless(lambda: dashboard.server.visitors.count > 0, feed.rest)
        announce(stream.name, dashboard.server, page_flags)
        session.start(play=not page_flags.paused)
        inspector = Inspector(session, wanted)
        stack.callback(inspector.close)
        wait_for(shutdown)


def _goal(words: tuple[str, ...]) -> tuple[tuple[float, ...] | None, str]:
    """Return the place [m] of a goal, if one is given, and the topic that it follows from then on."""
    from aero_viz.recordings.source import checked_goal

    if not words:
        return None, _GOAL_TOPIC
    if len(words) == 1 and words[0].startswith("/"):
        return None, words[0]
    try:
        place = tuple(map(float, words))
    except ValueError:
        place = ()
    if len(place) != 3:
        raise UserError(f"--goal is a topic, such as {_GOAL_TOPIC}, or three numbers x y z [m], not {' '.join(words)}.")
    checked_goal(place)
    return place, _GOAL_TOPIC


class _GraphReport:
    """The topics of the graph."""

    def __init__(self, topics: list[Topic]) -> None:
        from aero_viz.ros.feed import missing_package, readable_type

        self._rows = [(topic, readable_type(topic), missing_package(topic)) for topic in topics]

    def to_dict(self) -> dict[str, Any]:
        """Return the topics as plain values for JSON."""
        return {
            "topics": [
                {
                    "name": topic.name,
                    "type": topic.types[0],
                    "publishers": topic.publishers,
                    "readable": kind is not None,
                }
                for topic, kind, _ in self._rows
            ]
        }

    def format_table(self) -> str:
        """Return the topics as text."""
        if not self._rows:
            return "no topics: check ROS_DOMAIN_ID, and that the drivers run on this network"
        rows = []
        for topic, kind, package in self._rows:
            note = "<- can be read" if kind else f"<- needs {package}: source its workspace" if package else ""
            rows.append(["", topic.name, ", ".join(topic.types), str(topic.publishers), note])
        return format_table(rows, right=[3])


def _open_desk(stack: contextlib.ExitStack, livox: str | None, capture: Path | None) -> Stream:
    """Return the stream of a sensor or of a capture, which needs no ROS."""
    from aero_viz.live.stream import Stream

    if capture is not None:
        from aero_viz.live.player import Player

        stream = Stream(capture.name)
        stack.callback(Player(stream, capture).close)
        return stream
    from aero_viz.live.livox import LivoxFeed

    stream = Stream(f"Livox at {livox}")
    feed = LivoxFeed(stream, livox)
    stack.callback(feed.close)
    if not feed.wait(_DISCOVERY):
        raise UserError(
            f"Nothing arrives from a Livox at {livox} on port {feed.ports[0]}: check its cable and power, and that its "
            "host address is that of this computer (Livox Viewer)."
        )
    return stream


def _understand(
    stack: contextlib.ExitStack,
    stream: Stream,
    feed: Feed | None,
    wanted: Wanted,
    method: str | None,
    imu: str | None,
    goal_topic: str,
    shutdown: threading.Event,
) -> Setup | None:
    """Choose the topics, say what is assumed, and keep only what is used; None if the program is to end."""
    if feed is not None:
        _choose_candidates(feed, wanted, method, imu, goal_topic, shutdown)
    _wait(lambda: shutdown.is_set(), _LISTENING)
    estimated: OnlineOdometry | None = None
    if method is not None:
        clouds = _find(stream, dataclasses.replace(wanted, odometry=None), lambda _: True, lambda: "", shutdown)
        if clouds is None:
            return None
        from aero_viz.live.odometry import OnlineOdometry

        wanted = dataclasses.replace(wanted, points=clouds.points)
        estimated = OnlineOdometry(stream, method, points=clouds.points, imu=imu, mount=wanted.mount)
        stack.callback(estimated.close)

    def is_complete(setup: Setup) -> bool:
        return setup.poses is not None or not _expects_poses(feed, wanted)

    setup = _find(stream, wanted, is_complete, lambda: "" if estimated is None else estimated.missing, shutdown)
    if setup is None:
        return None
    if feed is not None:
        known = {**feed.candidates(), **{name: health.type for name, health in stream.topics.items()}}
        used = {name: known[name] for name in setup.used if name in known}
        imus = {name: kind for name, kind in feed.topics.items() if method == "rko-lio" and kind.endswith("/Imu")}
        feed.use({**used, **imus, goal_topic: _goal_type(feed, goal_topic)})
    for text in (*setup.assumptions, setup.measured.format_line()):
        say(f"  {text}")
    return setup


def _find(
    stream: Stream,
    wanted: Wanted,
    is_complete: Callable[[Setup], bool],
    missing: Callable[[], str],
    shutdown: threading.Event,
) -> Setup | None:
    """Return how to read a stream as soon as that is complete, or after a while; None if the program is to end.

    Raises:
        UserError: it cannot be read; says why, by `missing` if that knows.
    """
    from aero_viz.live.setup import find_setup

    deadline = time.monotonic() + _DISCOVERY
    while not shutdown.is_set():
        is_late = time.monotonic() > deadline
        try:
            setup = find_setup(stream, wanted)
        except UserError as error:
            if is_late:
                silent = [name for name, health in stream.topics.items() if not health.count]
                advice = missing() or (f"Nothing arrives on {', '.join(silent)}." if silent else str(error))
                raise UserError(f"{advice} Listened for {_DISCOVERY + _LISTENING:.0f} s.") from error
        else:
            if is_late or is_complete(setup):
                return setup
        _wait(lambda: shutdown.is_set(), 5 * _POLL)
    return None


def _when_ready(open_source: Callable[[], StreamSource], shutdown: threading.Event) -> StreamSource | None:
    """Return the source once a sweep has its pose; None if the program is to end. UserError if that takes too long."""
    deadline = time.monotonic() + _DISCOVERY
    while not shutdown.is_set():
        try:
            return open_source()
        except UserError:
            if time.monotonic() > deadline:
                raise
        _wait(shutdown.is_set, _POLL)
    return None


def _goal_type(feed: Feed, topic: str) -> str:
    """Return the type of the topic that the goal follows, that of RViz's goals where nobody publishes it yet."""
    from aero_viz.live.source import GOAL_TYPES

    types = feed.graph.types(topic)
    if types.isdisjoint(GOAL_TYPES) and types:
        raise UserError(f"--goal {topic} has {', '.join(types)}; a goal comes from {', '.join(GOAL_TYPES)}.")
    return next((kind for kind in GOAL_TYPES if kind in types), GOAL_TYPES[0])


def _expects_poses(feed: Feed | None, wanted: Wanted) -> bool:
    from aero_viz.recordings.pose_messages import POSE_TYPES
    from aero_viz.recordings.ros_messages import TF_TYPES

    if wanted.odometry is not None:
        return True
    return feed is not None and any(kind in (*POSE_TYPES, *TF_TYPES) for kind in feed.topics.values())


def _choose_candidates(
    feed: Feed, wanted: Wanted, method: str | None, imu: str | None, goal_topic: str, shutdown: threading.Event
) -> None:
    """List the graph, and listen to what may be used."""
    from aero_viz.recordings.clouds import CLOUD_TYPES
    from aero_viz.recordings.depth_image import CAMERA_INFO
    from aero_viz.recordings.imu_messages import IMU_TYPE
    from aero_viz.recordings.pose_messages import POSE_TYPES
    from aero_viz.recordings.ros_messages import TF_TYPES

    def found() -> bool:
        kinds = feed.candidates()
        named = [name for name in (wanted.points, None if method else wanted.odometry) if name is not None]
        return shutdown.is_set() or (any(k in CLOUD_TYPES for k in kinds.values()) and all(n in kinds for n in named))

    _wait(found, _DISCOVERY)
    _wait(lambda: shutdown.is_set(), 10 * _POLL)  # for what is found a little later
    say(_GraphReport(feed.graph.topics()).format_table())
    candidates = feed.candidates()
    if not any(kind in CLOUD_TYPES for kind in candidates.values()) and not shutdown.is_set():
        raise UserError(
            f"ROS 2 has no topic of clouds that can be read in domain {feed.graph.domain}: start the driver, check "
            "ROS_DOMAIN_ID, or list the topics with: aero-viz live --list"
        )
    # What is of no use is said at once.
    _goal_type(feed, goal_topic)
    for name, role in ((wanted.points, "points"), (None if method else wanted.odometry, "pose"), (imu, "IMU")):
        if name is not None and not shutdown.is_set():
            feed.check(name, role)
    chosen: dict[str, str] = {}
    for name, kind in candidates.items():
        is_cloud = kind in CLOUD_TYPES and wanted.points in (None, name)
        is_pose = kind in POSE_TYPES and wanted.odometry in (None, name) and name not in (_GOAL_TOPIC, goal_topic)
        is_imu = kind == IMU_TYPE and method == "rko-lio" and imu in (None, name)
        if is_cloud or is_pose or is_imu or kind in (*TF_TYPES, CAMERA_INFO):
            chosen[name] = kind
    feed.use(chosen)


def _wait(condition: Callable[[], object], timeout: float) -> None:
    """Wait until a condition holds, for at most `timeout` [s]."""
    deadline = time.monotonic() + timeout
    while not condition() and time.monotonic() < deadline:
        time.sleep(_POLL)
