"""Subscriptions and publishers of the node, and the problems found on their topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
import time
from typing import Any, NamedTuple

from boxreg_ros.errors import ConfigError, UnsupportedMessage
from boxreg_ros.live.diagnostics import diagnosis, Health
from boxreg_ros.live.polling import NO_EVENTS, PolledGroup, taken
from boxreg_ros.reasons import Reason
from diagnostic_msgs.msg import DiagnosticStatus
from msg_adapters import canonical, CLOUD_TYPES
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSPolicyKind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.topic_endpoint_info import TopicEndpointInfo

PATIENCE = 10.0
"""A topic without publishers or messages is reported this long after its subscription [s]."""
MAX_QOS_DEPTH = 2**31 - 1
"""Longest queue; derived: DDS counts its samples by a signed integer of 32 bits."""
QOS_POLICIES: dict[str, Any] = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
}
"""Policies with named values that parameters may override."""
QOS_OVERRIDES = QoSOverridingOptions(
    [QoSPolicyKind[policy.upper()] for policy in (*QOS_POLICIES, 'depth')]
)
"""Policies that parameters ``qos_overrides.TOPIC.ENTITY.POLICY`` may set."""
RCLPY_TOPICS = ('/clock', '/parameter_events', '/rosout')
"""Topics of every node, whose QoS overrides rclpy takes."""
TF_TOPIC = '/tf'
"""Of moving transforms, as of tf2; a robot in a namespace has it there."""
BOXES_TOPICS = {False: 'refined_boxes', True: 'refined_boxes_final'}
"""Topics of early (False) and final (True) boxes."""
FOLLOW_TOPIC = '~/follow'
"""Boxes of a person, whose objects are followed."""
INFINITE_NS = 9223372036854775807
"""Value of an infinite duration in rmw [ns]."""


class TopicProblem(NamedTuple):
    """Something that keeps messages from arriving; `level` is one of DiagnosticStatus."""

    text: str
    level: bytes = DiagnosticStatus.WARN
    is_qos: bool = False


@dataclass(eq=False, slots=True)
class Endpoint:
    """A subscription or publisher of the node."""

    type_name: str  # as ``package/msg/Type``
    topic: str  # before namespace and remaps
    qos: QoSProfile  # overrides are written into it when the entity is made
    callback: Callable[..., None] | None = None  # takes the messages of a subscription
    is_required: bool = False  # the node refines nothing without messages on it
    is_raw: bool = False  # the callback takes bytes
    # messages wait for `NodeTopics.poll`; the callback also takes the time of receipt [ns]
    is_polled: bool = False
    name: str = ''  # of the topic, after namespace and remaps, once the entity is made
    entity: Any = None  # of rclpy
    # when the endpoint was made (monotonic) [s]
    since: float = field(default_factory=time.monotonic)
    received: int = 0  # number of messages

    @property
    def is_input(self) -> bool:
        """Return whether this is a subscription."""
        return self.callback is not None


class NodeTopics:
    """The topics of the node beside those of others; for the executor's thread but for `poll`."""

    def __init__(self, node: Node, health: Health) -> None:
        self._node = node
        self._health = health
        self._endpoints: list[Endpoint] = []
        self._logged: set[str] = set()
        self._polled = PolledGroup()

    def subscribe(self, endpoint: Endpoint) -> None:
        """
        Create a subscription.

        With reliability ``BEST_AVAILABLE``, rclpy chooses by the publishers that exist when it
        subscribes. The subscription is created anew when one comes that offers less.

        Parameters
        ----------
        endpoint : Endpoint
            Type, topic, QoS profile and callback; parameters may override its QoS profile.

        Raises
        ------
        ConfigError
            For a wrong QoS override and for a topic that the node uses with another type.
        UnsupportedMessage
            If the message package is missing.

        """
        self._name(endpoint)
        self._create_subscription(endpoint)
        self._endpoints.append(endpoint)

    def publish(self, type_name: str, topic: str, depth: int) -> Publisher:
        """
        Create a publisher.

        Parameters
        ----------
        type_name : str
            As ``package/msg/Type``.
        topic : str
            Before namespace and remaps.
        depth : int
            Messages in its queue; parameters may override this QoS profile.

        Returns
        -------
        publisher : Publisher
            Of rclpy.

        Raises
        ------
        ConfigError, UnsupportedMessage
            As of `subscribe`.

        """
        kind = import_message(type_name)
        endpoint = Endpoint(type_name, topic, QoSProfile(depth=depth))
        self._name(endpoint)
        events = PublisherEventCallbacks(
            incompatible_qos=lambda _: self._health.count(Reason.QOS_INCOMPATIBLE)
        )
        _check_overrides(self._node, f'qos_overrides.{endpoint.name}.publisher')
        endpoint.entity = self._node.create_publisher(
            kind, topic, endpoint.qos, event_callbacks=events,
            qos_overriding_options=QOS_OVERRIDES,
        )  # fmt: skip
        self._endpoints.append(endpoint)
        publisher: Publisher = endpoint.entity
        return publisher

    def poll(self) -> None:
        """Handle the messages of polled subscriptions that have arrived; in any one thread."""
        for endpoint in self._endpoints:
            if endpoint.is_polled and endpoint.callback is not None:
                for message, received_ns in taken(endpoint.entity):
                    endpoint.received += 1
                    endpoint.callback(message, received_ns)

    def close(self) -> None:
        """Destroy all subscriptions and publishers."""
        for endpoint in self._endpoints:
            if endpoint.is_input:
                self._node.destroy_subscription(endpoint.entity)
            else:
                self._node.destroy_publisher(endpoint.entity)
        self._endpoints.clear()

    def description(self) -> str:
        """Return one line with the resolved name, type and QoS of every topic."""
        subscribed = [_described(item) for item in self._endpoints if item.is_input]
        published = [_described(item) for item in self._endpoints if not item.is_input]
        return f'subscribed to {"; ".join(subscribed)}. Publishing {"; ".join(published)}'

    def warn_of_unused_overrides(self) -> None:
        """Log the QoS overrides that no topic takes; for when all topics are there."""
        used = {
            f'{item.name}.{"subscription" if item.is_input else "publisher"}.{policy}'
            for item in self._endpoints
            for policy in (*QOS_POLICIES, 'depth')
        }
        given: dict[str, Any] = self._node.get_parameters_by_prefix('qos_overrides')
        unused = sorted(n for n in given if n not in used and not n.startswith(RCLPY_TOPICS))
        if unused:
            self._node.get_logger().warning(
                f'qos_overrides.{", qos_overrides.".join(unused)}: ignored; expected '
                f'TOPIC.subscription.POLICY or TOPIC.publisher.POLICY, a topic as named above and '
                f'{", ".join(QOS_POLICIES)} or depth: correct the name'
            )

    def box_publishers(self) -> dict[bool | None, list[TopicEndpointInfo]]:
        """
        Return the publishers of boxes by whether these are refined by a node of this kind.

        None is of those that were discovered before their node, which may be of this kind.

        """
        found: dict[bool | None, list[TopicEndpointInfo]] = {True: [], False: [], None: []}
        for peer in self._node.get_publishers_info_by_topic('boxes'):
            found[self._refines(peer.node_name, peer.node_namespace)].append(peer)
        return found

    def problems(self) -> list[TopicProblem]:
        """Return the reasons why messages do not arrive now, on any topic of the node."""
        found: list[TopicProblem] = []
        for endpoint in self._endpoints:
            if endpoint.is_input:
                peers = self._node.get_publishers_info_by_topic(endpoint.topic)
            else:
                peers = self._node.get_subscriptions_info_by_topic(endpoint.topic)
            same_type = [peer for peer in peers if peer.topic_type == endpoint.type_name]
            other_type = [peer for peer in peers if peer.topic_type != endpoint.type_name]
            found += qos_problems(endpoint, same_type)
            if other_type and not (endpoint.is_input and same_type):
                found.append(_type_problem(endpoint, other_type))
            if endpoint.is_input:
                found += self._silence(endpoint, peers)
            elif endpoint.topic in BOXES_TOPICS.values():
                found += self._published_twice(endpoint)
            if endpoint.topic == TF_TOPIC and not peers:
                found += self._other_transforms(endpoint)
            if endpoint.topic == FOLLOW_TOPIC and not peers:
                found += self._unheard(endpoint)
        return found

    def report(self, name: str, further: list[TopicProblem]) -> DiagnosticStatus:
        """Log new problems, these and further ones, and return the state of all topics."""
        problems = [*self.problems(), *further]
        for problem in problems:
            if problem.text not in self._logged:
                self._log(problem)
        self._logged = {problem.text for problem in problems}
        values = {
            f'{"subscription" if item.is_input else "publisher"} {item.topic}': _described(item)
            for item in self._endpoints
        }
        values |= {f'problem {i}': problem.text for i, problem in enumerate(problems, start=1)}
        level = max((problem.level for problem in problems), default=DiagnosticStatus.OK)
        message = '; '.join(problem.text for problem in problems) or 'connected'
        return diagnosis(name, level, message, values)

    def unpublished(self, topic: str, type_names: set[str]) -> TopicProblem:
        """Return the problem that nobody publishes a topic, with topics of the types wanted."""
        name = self._node.resolve_topic_name(topic)
        there = ', '.join(self._published_topics(type_names)) or 'none'
        remedy = f'start the publisher or remap {topic}'
        if self._is_remapped(topic):
            remedy = 'check the remap'
        return TopicProblem(
            f'{name}: nobody publishes it; published topics of a fitting type: {there}; {remedy}',
        )

    def _name(self, endpoint: Endpoint) -> None:
        """Resolve a topic; raise ConfigError if the node uses it with another type already."""
        endpoint.name = self._node.resolve_topic_name(endpoint.topic)
        for other in self._endpoints:
            if other.name == endpoint.name and other.type_name != endpoint.type_name:
                raise ConfigError(
                    f'{endpoint.topic}: expected a topic of its own, got {other.name!r}, which '
                    f'this node uses as {other.topic} with type {other.type_name}; correct the '
                    f'remap'
                )

    def _create_subscription(self, endpoint: Endpoint) -> None:
        """Create the subscription of an endpoint, in place of the one it has."""
        kind = import_message(endpoint.type_name)
        events = NO_EVENTS
        if not endpoint.is_polled:
            events = SubscriptionEventCallbacks(
                incompatible_qos=partial(self._on_incompatible_publisher, endpoint),
                message_lost=partial(self._on_lost, endpoint),
            )
        if endpoint.entity is not None:
            self._node.destroy_subscription(endpoint.entity)
        _check_overrides(self._node, f'qos_overrides.{endpoint.name}.subscription')
        endpoint.entity = self._node.create_subscription(
            kind, endpoint.topic, partial(self._on_message, endpoint), endpoint.qos,
            event_callbacks=events, raw=endpoint.is_raw,
            qos_overriding_options=QOS_OVERRIDES,
            callback_group=self._polled if endpoint.is_polled else None,
        )  # fmt: skip

    def _on_message(self, endpoint: Endpoint, message: Any) -> None:
        assert endpoint.callback is not None  # only subscriptions have messages
        endpoint.received += 1
        endpoint.callback(message)

    def _on_incompatible_publisher(self, endpoint: Endpoint, event: Any) -> None:
        is_reliability = event.last_policy_kind == QoSPolicyKind.RELIABILITY
        is_adaptive = endpoint.qos.reliability == ReliabilityPolicy.BEST_AVAILABLE
        executor = self._node.executor
        if is_reliability and is_adaptive and executor is not None:
            executor.create_task(self._create_subscription, endpoint)
        else:
            self._health.count(Reason.QOS_INCOMPATIBLE)

    def _on_lost(self, endpoint: Endpoint, event: Any) -> None:
        self._health.count(f'{endpoint.topic}_lost', event.total_count_change)

    def _silence(
        self, endpoint: Endpoint, peers: list[TopicEndpointInfo]
    ) -> Iterator[TopicProblem]:
        """Yield a problem if nothing was ever received on an endpoint that ought to have some."""
        is_expected = endpoint.is_required or self._is_remapped(endpoint.topic)
        if not is_expected or endpoint.received or time.monotonic() < endpoint.since + PATIENCE:
            return
        if not peers:
            yield self.unpublished(endpoint.topic, {endpoint.type_name})
        elif any(peer.topic_type == endpoint.type_name for peer in peers):
            yield TopicProblem(
                f'{endpoint.name}: nothing received yet from {nodes_of(peers)}; check that '
                f'messages are sent, and shared memory and network in between',
            )

    def _published_twice(self, endpoint: Endpoint) -> Iterator[TopicProblem]:
        """Yield a problem if others publish refined boxes on the topic of this node, too."""
        publishers = self._node.get_publishers_info_by_topic(endpoint.topic)
        if len(publishers) > 1:
            yield TopicProblem(
                f'{endpoint.name}: expected this node alone to publish it, got {len(publishers)} '
                f'publishers, of {nodes_of(publishers)}: who subscribes gets the boxes of all; '
                f'end the others, leave the topic out of a recording that is played, or remap '
                f'{endpoint.topic}',
            )

    def _is_remapped(self, topic: str) -> bool:
        plain = self._node.resolve_topic_name(topic, only_expand=True)
        return self._node.resolve_topic_name(topic) != plain

    def _other_transforms(self, endpoint: Endpoint) -> Iterator[TopicProblem]:
        """Yield a problem if nobody publishes transforms here, but somebody in a namespace."""
        published = self._published_topics({endpoint.type_name})
        others = [topic for topic in published if topic.endswith(TF_TOPIC)]
        if others and not endpoint.received:
            yield TopicProblem(
                f'{endpoint.name}: nobody publishes it, but transforms are published on '
                f'{", ".join(others)}; if the clouds are of that robot, start the node with -r '
                f'{TF_TOPIC}:={others[0]} -r {TF_TOPIC}_static:={others[0]}_static',
            )

    def _unheard(self, endpoint: Endpoint) -> Iterator[TopicProblem]:
        """Yield a problem for each topic of the same last name and type that nobody reads."""
        last = endpoint.name.rsplit('/', 1)[-1]
        for topic, types in self._node.get_topic_names_and_types():
            is_like = topic.rsplit('/', 1)[-1] == last and endpoint.type_name in types
            if is_like and not self._node.count_subscribers(topic):
                yield TopicProblem(
                    f'{topic}: nobody subscribes to it; this node takes boxes to follow on '
                    f'{endpoint.name}: publish there',
                )

    def _refines(self, name: str, namespace: str) -> bool | None:
        """
        Return whether a node is of this kind, by its services: topics may be remapped.

        None for a node that is not known yet, or no longer. DDS announces the readers of requests
        apart from the writers, and the writers in the order in which they were made. So a node
        whose publisher of boxes is known also has known writers of responses, made before it.

        """
        try:
            services = self._node.get_service_names_and_types_by_node(name, namespace)
            writers = self._node.get_publisher_names_and_types_by_node(
                name, namespace, no_demangle=True
            )
        except RuntimeError:
            return None
        known = {known for known, _ in (*services, *writers)}
        prefix = f'{namespace.rstrip("/")}/{name}'
        return all(
            known & {f'{prefix}/{service}', f'rr{prefix}/{service}Reply'}
            for service in ('save_config', 'reset')
        )

    def _published_topics(self, type_names: set[str]) -> list[str]:
        """Return the topics of given types that nodes publish, those of refined boxes excluded."""
        found = set()
        for node in self._node.get_node_names_and_namespaces():
            if self._refines(*node):
                continue
            try:
                topics = self._node.get_publisher_names_and_types_by_node(*node)
            except RuntimeError:  # it has ended in the meantime
                continue
            found |= {topic for topic, types in topics if type_names & set(types)}
        return sorted(found)

    def _log(self, problem: TopicProblem) -> None:
        if problem.is_qos:
            self._health.is_due(Reason.QOS_INCOMPATIBLE)  # this entry replaces the general one
        self._health.log(problem.text, problem.level == DiagnosticStatus.ERROR)


def import_message(type_name: str) -> type:
    """Return the class of a message type; raise UnsupportedMessage if its package is missing."""
    package, _, name = canonical(type_name).split('/')
    try:
        kind: type = getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise UnsupportedMessage(
            f'message type {type_name} is not installed: install the ROS package {package} '
            f'(apt: ros-jazzy-{package.replace("_", "-")}) or source the workspace that has it'
        ) from None
    return kind


def mismatches(offered: QoSProfile, requested: QoSProfile) -> list[tuple[str, str, str]]:
    """Return policies of which a publisher offers less than is requested: name and both values."""
    found = []
    for policy, weaker, stronger in (
        ('reliability', ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE),
        ('durability', DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL),
        ('liveliness', LivelinessPolicy.AUTOMATIC, LivelinessPolicy.MANUAL_BY_TOPIC),
    ):
        if (getattr(offered, policy), getattr(requested, policy)) == (weaker, stronger):
            found.append((policy, weaker.name.lower(), stronger.name.lower()))
    for policy in ('deadline', 'liveliness_lease_duration'):
        offer = getattr(offered, policy).nanoseconds or INFINITE_NS  # 0: the default, infinite
        request = getattr(requested, policy).nanoseconds or INFINITE_NS
        if offer > request:
            found.append((policy, _seconds(offer), _seconds(request)))
    return found


def _seconds(duration_ns: int) -> str:
    return 'infinite' if duration_ns >= INFINITE_NS else f'{1e-9 * duration_ns:g} s'


def qos_problems(endpoint: Endpoint, peers: list[TopicEndpointInfo]) -> Iterator[TopicProblem]:
    """Yield a problem for each policy for which an endpoint and a peer do not match."""
    for peer in peers:
        publisher, subscription = peer.qos_profile, endpoint.qos
        if not endpoint.is_input:
            publisher, subscription = subscription, publisher
        for policy, offered, requested in mismatches(publisher, subscription):
            theirs = 'publisher', 'offers', offered
            ours = 'subscription', 'requests', requested
            if not endpoint.is_input:
                theirs, ours = ours, theirs
            override = ''
            if policy in QOS_POLICIES:
                name = f'qos_overrides.{endpoint.name}.{ours[0]}.{policy}'
                override = f'set the parameter {name} to {theirs[2]}, or '
            text = (
                f'the {theirs[0]} of {nodes_of([peer])} {theirs[1]} {policy} {theirs[2]}, the '
                f'{ours[0]} of this node {ours[1]} {ours[2]}; {override}change the {theirs[0]}'
            )
            yield TopicProblem(f'{endpoint.name}: {text}', DiagnosticStatus.ERROR, is_qos=True)


def _type_problem(endpoint: Endpoint, peers: list[TopicEndpointInfo]) -> TopicProblem:
    """Return the problem that other nodes use an endpoint's topic with another type."""
    types = ', '.join(sorted({peer.topic_type for peer in peers}))
    if not endpoint.is_input:
        return TopicProblem(
            f'{endpoint.name}: {nodes_of(peers)} subscribes with type {types}, this node '
            f'publishes {endpoint.type_name}; change the subscription',
        )
    remedy = f'remap {endpoint.topic} to a topic of the expected type'
    if endpoint.topic == FOLLOW_TOPIC:
        remedy = 'publish boxes to follow as the type of boxes'
    if endpoint.type_name in CLOUD_TYPES and types in CLOUD_TYPES:
        remedy = f'set points_type:={types}'
    if endpoint.topic == 'boxes':
        remedy = 'set boxes_type, or restart the node if the type of the topic has changed'
    return TopicProblem(
        f'{endpoint.name}: expected messages of type {endpoint.type_name}, got {types} from '
        f'{nodes_of(peers)}; {remedy}',
        DiagnosticStatus.ERROR,
    )


def nodes_of(peers: list[TopicEndpointInfo]) -> str:
    """Return the full names of the nodes that endpoints belong to."""
    names = {f'{peer.node_namespace.rstrip("/")}/{peer.node_name}' for peer in peers}
    return ', '.join(sorted(names))


def _described(endpoint: Endpoint) -> str:
    """Return resolved name, type and QoS profile of an endpoint."""
    qos = endpoint.qos
    policies = ' '.join(
        item.name.lower() for item in (qos.reliability, qos.durability, qos.history)
    )
    return f'{endpoint.name} [{endpoint.type_name}] {policies} {qos.depth}'


def _check_overrides(node: Node, prefix: str) -> None:
    """Refuse a wrong QoS override by name; rclpy refuses some by bare assertions."""
    parameters: dict[str, Any] = node.get_parameters_by_prefix(prefix)  # wrong annotation in rclpy
    for policy, parameter in parameters.items():
        value = parameter.value
        if policy == 'depth':
            expected = f'a whole number from 1 to {MAX_QOS_DEPTH}'
            is_possible = type(value) is int and 1 <= value <= MAX_QOS_DEPTH
        elif policy in QOS_POLICIES:
            names = [name.lower() for name in QOS_POLICIES[policy].__members__]
            names.remove('unknown')
            expected = f'one of {", ".join(names)}'
            is_possible = str(value).lower() in names
        else:
            continue
        if not is_possible:
            raise ConfigError(
                f'{prefix}.{policy}: expected {expected}, got {value!r}; correct it or leave it '
                f'out'
            )
