"""A tongue in Blender that follows `tonguetrack` live, over OSC. For Blender 4 and 5; needs nothing besides Blender.

1. Make a tongue that can be driven: tonguetrack export poses.csv -o tongue.glb --sigmas 5
2. In Blender: File > Import > glTF 2.0, and choose tongue.glb. It has one shape key for each pose weight.
3. Open this file in the text editor of Blender and run it (Alt P), or install it as an add-on.
4. Select the tongue; in the sidebar of the 3D view (N), under Tongue, press Start.
5. tonguetrack demo (or live; both send to port 9000 unless told otherwise)

With Record on, every frame that Blender plays gets keyframes: press the space bar to play, and again to stop.

The shape keys go from 0 to 1. Which raw weights those are is in the mesh's custom properties weights_low and
weights_high, which the import keeps; `/tongue/pose` brings raw weights.
"""

import math
import socket
import struct

import bpy

bl_info = {
    "name": "Tongue over OSC",
    "author": "tonguetrack",
    "version": (1, 0, 0),
    "blender": (4, 0, 0),
    "location": "3D view > Sidebar > Tongue",
    "description": "Drives the shape keys of a tongue that tonguetrack exported",
    "category": "Animation",
}

LONGEST_DATAGRAM = 65536
MOST_AT_ONCE = 1000  # datagrams; a sender that is faster than this still lets Blender draw
PERIOD_S = 1 / 60


# OSC 1.0: numbers are big-endian, texts end in one to four zeros, to a multiple of 4 bytes ------------


def messages(packet):
    """(address, arguments) of every message in a datagram; of a damaged one, those before the damage."""
    found = []
    try:
        _read(packet, found, 0)
    except (struct.error, UnicodeDecodeError, ValueError):
        pass
    return found


def _read(packet, found, depth):
    if packet.startswith(b"#bundle\0"):
        if depth > 4:
            raise ValueError("bundles within bundles within bundles")
        place = 16
        while place < len(packet):
            (size,) = struct.unpack_from(">i", packet, place)
            place += 4
            if size <= 0 or place + size > len(packet):
                raise ValueError("an element longer than its datagram")
            _read(packet[place : place + size], found, depth + 1)
            place += size
        return
    address, place = _text(packet, 0)
    kinds, place = _text(packet, place)
    arguments = []
    for kind in kinds[1:]:
        if kind in "fi":
            (value,) = struct.unpack_from(">" + kind, packet, place)
            place += 4
        elif kind == "s":
            value, place = _text(packet, place)
        else:
            return  # of a kind that the tongue's own messages do not use
        arguments.append(value)
    found.append((address, arguments))


def _text(packet, place):
    end = packet.index(b"\0", place)
    return packet[place:end].decode(), (end // 4 + 1) * 4


# The tongue -----------------------------------------------------------------------------------------


def to_unit(weights, low, high):
    """Raw weights as values of shape keys: 0 at low, 1 at high."""
    return [(w - a) / (b - a) if b > a else 0.0 for w, a, b in zip(weights, low, high)]


def is_tongue(thing):
    """Whether it is a mesh that tonguetrack exported."""
    return (
        thing is not None and thing.type == "MESH" and thing.data.shape_keys and "weights_low" in thing.data
    )


class Receiver:
    """Listens on a UDP port and moves one tongue. Only the newest pose counts; nothing here ever waits."""

    def __init__(self, tongue, port, host="127.0.0.1"):
        self.tongue = tongue
        self.said = "waiting for poses"
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self.socket.bind((host, port))
        except OSError:
            self.socket.close()
            raise
        self.socket.setblocking(False)

    def close(self):
        self.socket.close()

    def newest_pose(self):
        """The last /tongue/pose that has arrived since the last call, as raw weights, or None."""
        newest = None
        for _ in range(MOST_AT_ONCE):
            try:
                packet = self.socket.recv(LONGEST_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionError:
                continue  # what Windows reports of an earlier datagram
            for address, arguments in messages(packet):
                if address == "/tongue/pose":
                    newest = arguments
        return newest

    def poll(self, keyframe=None):
        """Moves the tongue to the newest pose; with a frame number, keyframes it there. False when it is gone."""
        try:
            mesh, keys = self.tongue.data, self.tongue.data.shape_keys.key_blocks[1:]
        except (ReferenceError, AttributeError):
            return False  # deleted
        weights = self.newest_pose()
        if weights is None:
            return True
        low, high = list(mesh["weights_low"]), list(mesh["weights_high"])
        if not len(weights) == len(keys) == len(low) == len(high):
            self.said = f"poses have {len(weights)} weights, this tongue has {len(keys)}: another model"
            return True
        if not all(map(math.isfinite, weights)):
            return True
        for key, value in zip(keys, to_unit(weights, low, high)):
            key.value = value
            if keyframe is not None:
                key.keyframe_insert("value", frame=keyframe)
        self.said = "following"
        return True


# What stands in the sidebar -------------------------------------------------------------------------

_receiver = None


def _tick():
    """Called by Blender, again and again, while there is a receiver."""
    if _receiver is None:
        return None
    scene, screen = bpy.context.scene, bpy.context.screen
    playing = screen is not None and screen.is_animation_playing
    if not _receiver.poll(scene.frame_current if scene.tongue_record and playing else None):
        stop()
        return None
    return PERIOD_S


def start(tongue, port):
    """Makes this tongue follow the poses that arrive at the port."""
    global _receiver
    stop()
    _receiver = Receiver(tongue, port)
    action = tongue.data.shape_keys.animation_data
    if action is not None:
        action.action = None  # an exported take would move the keys back
    bpy.app.timers.register(_tick, persistent=True)
    return _receiver


def stop():
    global _receiver
    if _receiver is not None:
        _receiver.close()
        _receiver = None


class TONGUE_OT_follow(bpy.types.Operator):
    """Start or stop following the poses that arrive"""

    bl_idname = "tongue.follow"
    bl_label = "Follow"

    def execute(self, context):
        if _receiver is not None:
            stop()
            return {"FINISHED"}
        if not is_tongue(context.object):
            self.report({"ERROR"}, "Select a tongue that was imported from a .glb of tonguetrack export")
            return {"CANCELLED"}
        try:
            start(context.object, context.scene.tongue_port)
        except OSError as reason:
            self.report({"ERROR"}, f"Port {context.scene.tongue_port} cannot be used: {reason}")
            return {"CANCELLED"}
        return {"FINISHED"}


class TONGUE_PT_sidebar(bpy.types.Panel):
    bl_label = "Tongue"
    bl_idname = "TONGUE_PT_sidebar"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Tongue"

    def draw(self, context):
        self.layout.prop(context.scene, "tongue_port")
        self.layout.prop(context.scene, "tongue_record")
        self.layout.operator("tongue.follow", text="Start" if _receiver is None else "Stop")
        if _receiver is not None:
            self.layout.label(text=_receiver.said)


CLASSES = (TONGUE_OT_follow, TONGUE_PT_sidebar)


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.tongue_port = bpy.props.IntProperty(name="Port", default=9000, min=1, max=65535)
    bpy.types.Scene.tongue_record = bpy.props.BoolProperty(name="Record", default=False)


def unregister():
    stop()
    for each in CLASSES:
        bpy.utils.unregister_class(each)
    del bpy.types.Scene.tongue_port, bpy.types.Scene.tongue_record


if __name__ == "__main__":
    register()
