"""ROS bags with messages of any definition, for the tests of readers."""

import numpy as np

HEADER = "std_msgs/msg/Header"


def store_with(definitions, ros=1):
    """Return a type store of ROS 1 or 2 that knows these definitions too: {type: text of the .msg file}."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types = {}
    for name, text in definitions.items():
        types |= get_types_from_msg(text, name)
    store.register(types)
    return store


def made(store, kind, values):
    """Return a message with these fields, given as nested dicts and lists; the others are zero or empty."""
    fields = store.fielddefs[kind][1]
    unknown = set(values) - {name for name, _ in fields}
    assert not unknown, f"{kind} has no {unknown}"
    return store.types[kind](**{name: _value(store, how, values.get(name)) for name, how in fields})


def _value(store, how, given):
    node, detail = how
    if node.name == "BASE":
        return given if given is not None else "" if detail[0] == "string" else detail[0] == "bool" and False
    if node.name == "NAME":
        return made(store, detail, given or {})
    (inner_node, inner), length = detail
    if inner_node.name == "NAME":
        return [made(store, inner, g) for g in given or [{}] * length]
    if inner[0] == "string":
        return list(given or [])
    return np.array(given if given is not None else [0] * length, dtype="uint8" if inner[0] == "bool" else inner[0])


def stamped(seconds, frame=""):
    """Return a header as nested dicts."""
    whole = int(seconds)
    return {"stamp": {"sec": whole, "nanosec": round((seconds - whole) * 1e9)}, "frame_id": frame}


def write_bag_of(path, messages, definitions, ros=1):
    """Write a bag.

    Parameters
    ----------
    path : the file of a ROS 1 bag, the folder of a ROS 2 bag.
    messages : (time of recording in s, topic, type, fields) of each.
    definitions : {type: text} of the types that ROS does not bring.
    """
    store = store_with(definitions, ros)
    if ros == 1:
        from rosbags.rosbag1 import Writer

        writer, encode = Writer(path), store.serialize_ros1
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        writer, encode = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP), store.serialize_cdr
    connections = {}
    with writer as bag:
        for recorded, topic, kind, fields in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], round(recorded * 1e9), encode(made(store, kind, fields), kind))


def odometry(seconds, x=0.0):
    """Return a message of nav_msgs/Odometry on /odom, recorded when it was made."""
    pose = {"pose": {"position": {"x": x}, "orientation": {"w": 1.0}}}
    fields = {"header": stamped(seconds, "odom"), "child_frame_id": "base_link", "pose": pose}
    return seconds, "/odom", "nav_msgs/msg/Odometry", fields
