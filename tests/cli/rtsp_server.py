"""Serves one Matroska file with h264 and AAC over RTSP: ``/usr/bin/python3 rtsp_server.py FILE``, on a free port.

Run by the Python of the system, which has GStreamer's bindings. Prints the URL.
"""

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402  after the versions are chosen

Gst.init(None)
for element in ("filesrc", "matroskademux", "queue", "rtph264pay", "rtpmp4gpay"):
    Gst.ElementFactory.make(element)  # a first use may scan every plugin, for longer than a client waits
server = GstRtspServer.RTSPServer(service="0", address="127.0.0.1")
factory = GstRtspServer.RTSPMediaFactory(shared=False)
factory.set_launch(
    f'( filesrc location="{sys.argv[1]}" ! matroskademux name=d '
    "d. ! queue ! rtph264pay name=pay0 pt=96 config-interval=-1 d. ! queue ! rtpmp4gpay name=pay1 pt=97 )"
)
server.get_mount_points().add_factory("/camera", factory)
server.attach(None)
print(f"rtsp://127.0.0.1:{server.get_bound_port()}/camera", flush=True)
GLib.MainLoop().run()
