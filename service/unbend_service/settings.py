"""Settings: read once, from the environment (``UNBEND_...``) and the command line, and passed down."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Every setting of the service; the environment variable is the name in capitals after ``UNBEND_``."""

    model_config = SettingsConfigDict(env_prefix="UNBEND_", extra="ignore")

    role: Literal["all", "estimate", "render"] = Field(
        "all", description="What this node does; render asks a node that estimates, estimate refuses to render."
    )
    estimator_address: str | None = Field(
        None, description="With the role render: gRPC address of the estimation nodes, host:port or dns:///host:port."
    )
    estimator_timeout_s: float = Field(10.0, gt=0, description="Longest wait for an estimation node.")
    estimator_token_file: Path | None = Field(
        None, description="File that holds the token for that node, of the scope correct."
    )
    estimator_ca: Path | None = Field(
        None,
        description="PEM authorities of that node; set: asked over TLS, with the own certificate if there is one.",
    )

    http_host: str = Field("127.0.0.1", description="Address that HTTP listens on.")
    http_port: int = Field(8080, ge=0, le=65535, description="Port of HTTP; 0 takes a free one.")
    grpc_host: str = Field("127.0.0.1", description="Address that gRPC listens on.")
    grpc_port: int = Field(50051, ge=0, le=65535, description="Port of gRPC; 0 takes a free one.")

    ops_host: str = Field("127.0.0.1", description="Address of the listener for health and metrics.")
    ops_port: int | None = Field(
        None,
        ge=0,
        le=65535,
        description="Port of a listener for /livez, /readyz and /metrics alone, which HTTP then has no longer; "
        "0 takes a free one; unset: HTTP has them.",
    )

    tokens_file: Path | None = Field(
        None, description="File of the tokens that are accepted, read again when it changes; unset: anybody may call."
    )
    token_rate_per_s: float | None = Field(
        None, gt=0, description="Pictures and frames a second of one token, unless its line says; unset: no bound."
    )
    token_burst: int = Field(
        20, ge=1, description="Pictures and frames at once of a token with a rate, unless its line says."
    )
    token_streams: int = Field(64, ge=1, description="Streams of one token at once, unless its line says.")
    open_access: bool = Field(
        False, description="Listen on every address of the machine even though nobody has to show who he is."
    )
    cors_origins: str = Field(
        "", description="Origins whose pages may call the API, `https://a.example,https://b.example`; empty: none."
    )

    tls_cert: Path | None = Field(
        None, description="PEM chain of both transports, read again when it changes; unset: plain text."
    )
    tls_key: Path | None = Field(None, description="PEM key of the certificate.")
    tls_client_ca: Path | None = Field(
        None, description="PEM authorities; set: only clients with a certificate of theirs may connect."
    )
    tls_required: bool = Field(False, description="Do not start without a certificate.")

    renderer: Literal["auto", "egl", "cpu"] = Field("auto", description="auto: EGL on a hardware GPU, else cpu.")
    require_gpu: bool = Field(False, description="Not ready on a software renderer.")
    egl_device: int = Field(0, ge=0, le=255, description="Which EGL device, counted as the driver lists them.")
    workers: int = Field(
        0, ge=0, le=256, description="Render worker processes; 0: one per usable core, at most 4 on a GPU."
    )
    map_cache_bytes: int = Field(
        256 << 20, ge=1 << 20, description="Bound on the sampling maps that a worker keeps for grids and sizes in use."
    )
    slots_per_worker: int = Field(2, ge=1, le=16, description="Frames that a worker may hold at once.")
    shared_memory_bytes: int = Field(
        1 << 30, ge=1 << 20, description="Upper bound of the shared memory for frames under way."
    )
    queue_frames: int = Field(
        64,
        ge=2,
        description="Frames that may be under way: half of them single calls, one more of which is refused at once, "
        "half of streams, which wait.",
    )
    render_deadline_s: float = Field(30.0, gt=0, description="Longest time from acceptance to answer of one frame.")
    hang_s: float = Field(
        10.0,
        gt=0,
        description="A worker that draws one frame for longer is replaced, and the frame drawn by another; at most the "
        "render deadline.",
    )

    local_socket: Path | None = Field(
        None,
        description="Unix socket (mode 0600, in a folder that others cannot write to) over which clients of this host "
        "share memory for the raw frames of streams; unset: off.",
    )
    local_memory_bytes: int = Field(
        1 << 30, ge=1 << 20, description="Upper bound of the memory that clients share, all together."
    )

    model: str = Field("lineset", description="Estimator: the name of a model that ships, or a path to one.")
    estimator_threads: int = Field(0, ge=0, le=256, description="Threads of one estimate; 0: as many as usable cores.")
    known_images: int = Field(
        1024, ge=0, description="Pictures whose estimate is kept, so that the same picture is not looked at twice."
    )
    min_confidence: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Below this confidence a picture is left alone, from it on corrected all the way, unless the "
        "request says otherwise; unset: what the model's card advises, for its lens.",
    )
    grid_points: int = Field(65, ge=9, le=257, description="Rows and columns of the grids that are made.")

    body_bytes: int = Field(64 << 20, ge=1024, description="Largest request body; a larger one is refused with 413.")
    bodies_bytes: int = Field(
        512 << 20, ge=1024, description="Memory of all request bodies together; one more is refused with 429."
    )
    source_pixels: int = Field(100_000_000, ge=1, description="Most pixels of a source image.")
    animation_frames: int = Field(1, ge=1, description="Most frames of an animated image.")
    jpeg_quality: int = Field(92, ge=1, le=100, description="Quality when the request names none.")

    decoders: int = Field(0, ge=0, le=256, description="Processes that decode images; 0: one per usable core.")
    decode_memory_bytes: int = Field(
        2 << 30, ge=64 << 20, description="Memory that decoding one image may take, beside what a decoder starts with."
    )
    decode_deadline_s: float = Field(30.0, gt=0, description="Longest time that decoding one image may take.")
    pictures_bytes: int = Field(
        2 << 30, ge=1 << 20, description="Memory of all decoded images together; one more is refused with 429."
    )

    handshake_s: float = Field(
        10.0, gt=0, description="Longest wait for a TLS handshake, and for the first word of a gRPC client."
    )
    http_connections: int = Field(1024, ge=1, description="HTTP connections that may be open at once.")
    http_header_bytes: int = Field(64 << 10, ge=1024, description="Largest request line and headers; more gets 431.")
    http_header_s: float = Field(10.0, gt=0, description="Longest wait for a request line and headers.")
    http_stall_s: float = Field(
        15.0, gt=0, description="A body or an answer of which less than 16 KiB move in so long is given up."
    )
    grpc_calls: int = Field(1024, ge=1, description="gRPC calls and streams that may be under way at once.")
    grpc_metadata_bytes: int = Field(16 << 10, ge=4096, description="Largest metadata of a gRPC call.")

    streams: int = Field(256, ge=1, description="Streams that may be open at once.")
    stream_in_flight: int = Field(8, ge=1, le=256, description="Frames of one stream that may be under way at once.")
    stream_frames_bytes: int = Field(
        1 << 30,
        ge=1024,
        description="Memory of the frames that all streams hold; beyond it a stream reads the next one when it holds "
        "none.",
    )
    stream_idle_s: float = Field(60.0, gt=0, description="A stream without a frame for so long is closed.")
    stream_estimate_frames: int = Field(
        5, ge=1, le=64, description="Frames that the grid of a stream is estimated over, unless the stream says."
    )
    stream_estimate_wait_s: float = Field(
        1.0, gt=0, description="The grid of a stream is estimated over fewer frames if none came for so long."
    )
    grpc_message_bytes: int = Field(
        160 << 20, ge=1 << 20, description="Largest gRPC message; a raw 7680x4320 rgba frame takes 127 MiB."
    )

    grid_store: Literal["memory", "sqlite", "redis"] = Field(
        "memory", description="Where grids are kept: replicas that take each other's streams share sqlite or redis."
    )
    grid_store_path: Path = Field(Path("unbend-grids.sqlite3"), description="File of the sqlite grid store.")
    grid_store_entries: int = Field(10_000, ge=1, description="Most grids that are kept; the oldest goes first.")
    grid_store_ttl_s: float = Field(30 * 86_400.0, gt=0, description="Seconds after its last use that a grid is kept.")
    grid_store_local_entries: int = Field(
        1024, ge=1, description="Grids that a replica keeps itself, for when redis does not answer."
    )
    stream_lease_s: float = Field(
        5.0, gt=0, description="After so long another replica estimates a stream whose replica died over it."
    )

    redis_url: str = Field(
        "redis://127.0.0.1:6379/0", description="Redis of the redis grid store: redis://, rediss:// (TLS) or unix://."
    )
    redis_username: str | None = Field(None, description="User of redis, if it wants one and the URL names none.")
    redis_password: SecretStr | None = Field(None, description="Password of redis, if the URL has none.")
    redis_ca_file: Path | None = Field(None, description="Authorities that may sign redis; unset: the system's.")
    redis_cert_file: Path | None = Field(None, description="Certificate shown to redis, if it wants one.")
    redis_key_file: Path | None = Field(None, description="Key of that certificate.")
    redis_prefix: str = Field(
        "unbend", pattern=r"^[A-Za-z0-9._-]{1,64}$", description="What the names of all keys in redis begin with."
    )
    redis_timeout_s: float = Field(1.0, gt=0, description="Longest wait for redis; then a replica helps itself.")
    redis_retry_s: float = Field(
        2.0, gt=0, description="Pause between attempts to reach redis again, during which no call waits for it."
    )

    drain_notice_s: float = Field(
        0.5,
        ge=0,
        description="After SIGTERM the service says for so long that it is not ready, and still accepts, so that "
        "balancers look away before calls are refused.",
    )
    drain_s: float = Field(20.0, ge=0, description="Grace for accepted work after SIGTERM.")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="Least severe log line.")
    log_format: Literal["console", "json"] = Field("console", description="How log lines look.")
    otlp_endpoint: str | None = Field(
        None,
        description="Collector of OpenTelemetry traces (OTLP over gRPC), `http://host:4317`; needs [otel].",
    )
    trace_share: float = Field(
        1.0, ge=0, le=1, description="Share of the traces that begin here which are kept; callers decide on theirs."
    )


def settings_table() -> str:
    """Markdown table of every setting, for docs/configuration.md."""
    lines = ["| Variable | Default | Meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = "unset" if field.default is None else f"`{field.default}`"
        lines.append(f"| `UNBEND_{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines)
