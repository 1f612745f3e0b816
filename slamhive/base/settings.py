"""All settings. Each is one field of :class:`Settings`, which holds its default, unit, bounds and help.

``docs/settings.md`` is generated from these fields. :mod:`slamhive.base.settings_sources` reads their values.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

ENVIRONMENT_PREFIX = "SLAMHIVE_"
LARGEST = {"bytes": 1e15}
"""The largest number of a unit. All other numbers end at 1e9: that is 30 years in s, so sums with dates stay valid."""


class Mode(StrEnum):
    """Purpose of this installation."""

    WORKSTATION = "workstation"
    VIEW_ONLY = "view-only"
    CLUSTER = "cluster"
    CLOUD = "cloud"

    @property
    def has_other_machines(self) -> bool:
        """Tell if algorithms run on other machines only. Those of a cloud are rented, and form a cluster."""
        return self in {Mode.CLUSTER, Mode.CLOUD}


class Auth(StrEnum):
    """Tell if callers of the web server sign in."""

    AUTO = "auto"
    ACCOUNTS = "accounts"
    NONE = "none"


class NewAccounts(StrEnum):
    """The role of accounts that are made when somebody signs in whom only the provider knows."""

    NONE = "none"
    READER = "reader"
    MEMBER = "member"


class NewRuns(StrEnum):
    """Visibility of what accounts make until its owner says otherwise. Nothing is public unasked."""

    PRIVATE = "private"
    TEAM = "team"


class MailSecurity(StrEnum):
    """Protection of the connection to a mail server."""

    STARTTLS = "starttls"
    TLS = "tls"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class ExecutorOption:
    """A text that users set for one executor, which declares it. It is no field of :class:`Settings`.

    Attributes:
        name: In lower case. As a setting, it is called ``<EXECUTOR>_<NAME>``.
        default: Its value unless the user sets it.
        help: For ``docs/settings.md`` and ``slamhive settings``.
        secret: It is shown nowhere.
    """

    name: str
    default: str
    help: str
    secret: bool = False


@dataclass(frozen=True, slots=True)
class SettingKind:
    """Bounds of a setting. ``kind`` is the type of its values; numbers are from ``minimum`` to ``maximum``.

    ``unit`` is that of the number, empty for none. The value of a ``secret`` is shown nowhere.
    """

    kind: type[Any]
    default: Any
    help: str
    unit: str
    minimum: float | None
    maximum: float | None
    secret: bool


def setting(
    default: Any,
    help_text: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    secret: bool = False,
) -> Any:
    """A field of :class:`Settings` with its documentation. Its values have the type of ``default``."""
    kind = Path if isinstance(default, Path) else type(default)
    highest = LARGEST.get(unit, 1e9) if kind in (int, float) and maximum is None else maximum
    about = SettingKind(kind, default, help_text, unit, minimum, highest, secret)
    return field(default=default, repr=not secret, metadata={SettingKind: about})


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of one installation; :mod:`slamhive.base.settings_sources` checks what users set.

    ``further``: the values, by name in lower case, of settings that an executor declares, unless they are left out.
    """

    mode: Mode = setting(
        Mode.WORKSTATION, "workstation, view-only, or cluster and cloud, where algorithms run on other machines only"
    )
    data: Path = setting(
        Path("data"),
        "Data root: datasets, runs, database; relative paths start at the checkout. Without one, the default is "
        "~/.local/share/slamhive, see quick-start.md",
    )
    database_url: str = setting("", "SQLAlchemy URL; empty means SQLite at <data>/slamhive.db")
    host: str = setting("127.0.0.1", "Address the web server binds to")
    port: int = setting(5000, "Port the web server binds to", minimum=0, maximum=65535)
    secret_key: str = setting(
        "", "Signs sessions and forms; empty means a random key kept in <data>/secret_key", secret=True
    )
    auth: Auth = setting(
        Auth.AUTO,
        "Who may use the web server: accounts, none (all who reach it), or auto (accounts unless HOST is loopback)",
    )
    oidc_issuer: str = setting(
        "", "Address of a provider of OpenID Connect whose users may sign in; empty for none. Needs slamhive[oidc]"
    )
    oidc_client_id: str = setting("", "What the provider calls this server")
    oidc_client_secret: str = setting("", "The secret that the provider gave this server", secret=True)
    oidc_title: str = setting("your organisation", "The provider's name on the page to sign in")
    oidc_new_accounts: NewAccounts = setting(
        NewAccounts.NONE,
        "Role of new accounts for unknown users of the provider: none (makes no account), reader or member",
    )
    new_runs: NewRuns = setting(
        NewRuns.TEAM,
        "Who sees new runs, experiments and analyses of accounts: private (owner and admins) or team (who signs in)",
    )
    trusted_proxy: str = setting(
        "", "Address of a reverse proxy whose X-Forwarded-For, -Host and -Proto headers are believed; empty for none"
    )
    connections_per_address: int = setting(
        50, "Most connections of one network address to the web server; TRUSTED_PROXY may have more", minimum=1
    )
    public_url: str = setting(
        "",
        "Address at which people reach the web server, for links in messages; behind a proxy, pages are served under"
        " its name; empty for none",
    )
    notify_webhook: str = setting(
        "", "Address that is sent a message when an experiment ends or fails; empty for none", secret=True
    )
    notify_webhook_secret: str = setting("", "Signs these messages (HMAC-SHA256); empty for no signature", secret=True)
    notify_mail_to: str = setting("", "E-mail addresses for the same messages, with commas; empty for none")
    notify_mail_from: str = setting("", "Sender of these e-mails; empty means SMTP_USER")
    notify_failures: int = setting(
        3,
        "An experiment is failing once so many runs in a row have failed; 0: no message",
        minimum=0,
        maximum=1000,
    )
    smtp_host: str = setting("", "Server that sends e-mail")
    smtp_port: int = setting(587, "Its port", minimum=1, maximum=65535)
    smtp_security: MailSecurity = setting(MailSecurity.STARTTLS, "Protects the connection: starttls, tls or none")
    smtp_user: str = setting("", "User name there; empty for none")
    smtp_password: str = setting("", "Password there", secret=True)
    executor: str = setting(
        "auto", "An executor that `slamhive doctor --all` lists; auto takes the first that can be used"
    )
    cloud_join: str = setting(
        "", "Shell command that makes a rented machine a node of the cluster, see cloud.md", secret=True
    )
    cloud_endpoint: str = setting("", "Server that speaks the API of EC2 or ECS; empty means the provider's own")
    shared_storage: bool = setting(
        True,
        "Whether nodes of Slurm and Kubernetes see the data root: true, or false to give them data by HTTP",
    )
    node_address: str = setting("", "HOST:PORT at which the worker serves nodes without shared storage; empty for none")
    node_url: str = setting("", "Address at which nodes reach NODE_ADDRESS, such as a proxy's; empty for the same")
    node_cache: str = setting("/var/tmp/slamhive-cache", "Folder on each node for data of runs")  # noqa: S108 - it stays
    node_cache_bytes: int = setting(
        100_000_000_000, "Most that data of runs takes on each node; unused data goes", unit="bytes", minimum=0
    )
    worker_slots: int = setting(1, "Runs at a time; more than 1 gives each slot cores of its own", minimum=1)
    any_cpu: bool = setting(
        False, "Runs may leave the CPU model on which their experiment began, such as on a new machine: true or false"
    )
    run_cpu_cores: float = setting(0.0, "CPU limit of a run; 0 means all cores of the slot", unit="cores", minimum=0)
    run_memory_mb: int = setting(0, "Memory limit of a run; 0 means what the algorithm asks for", unit="MB", minimum=0)
    run_pids: int = setting(512, "Most processes and threads of a run", minimum=16)
    run_disk_mb: int = setting(10_000, "Most that a run may write into its result and /tmp", unit="MB", minimum=1)
    run_files: int = setting(100_000, "Most files and folders of a run in its result and /tmp", minimum=100)
    run_timeout_factor: float = setting(3.0, "Time limit: this times the dataset's duration, plus slack", minimum=0)
    run_timeout_slack_s: float = setting(60.0, "Time limit: added to factor times duration", unit="s", minimum=0)
    stop_grace_s: float = setting(5.0, "Time between asking a run to end and killing it", unit="s", minimum=0)
    poll_interval_s: float = setting(0.2, "How often the worker looks at its runs", unit="s", minimum=0.01)
    sample_interval_s: float = setting(0.1, "Time between CPU and memory samples", unit="s", minimum=0.01)
    disturbed_time_fraction: float = setting(
        0.1, "A run is disturbed if a limit below is exceeded for more than this share of it", minimum=0, maximum=1
    )
    disturbed_others_fraction: float = setting(
        0.25, "Limit of the share of the run's cores that other processes keep busy", minimum=0, maximum=1
    )
    disturbed_steal_fraction: float = setting(
        0.05, "Limit of the share of CPU time that the hypervisor gives to other machines", minimum=0, maximum=1
    )
    disturbed_cpu_pressure: float = setting(
        0.3, "Limit of CPU pressure; counts only with half of the allowed load of others", minimum=0, maximum=1
    )
    disturbed_io_pressure: float = setting(0.4, "Limit of disk pressure", minimum=0, maximum=1)
    disturbed_memory_pressure: float = setting(0.1, "Limit of memory pressure", minimum=0, maximum=1)
    disturbed_throttle_events: int = setting(
        0, "A run is disturbed if the processor was too hot more often than this", minimum=0
    )
    disturbed_player_lag_s: float = setting(
        0.5, "A run is disturbed if the player was later than this against its schedule", unit="s", minimum=0
    )
    lease_s: float = setting(30.0, "A worker silent for longer has lost its runs to the next", unit="s", minimum=1)
    database_retry_s: float = setting(60.0, "How long a locked or absent database is tried again", unit="s", minimum=0)
    log_max_bytes: int = setting(10_000_000, "Most bytes kept of a run's log", unit="bytes", minimum=1000)
    min_free_disk_mb: int = setting(500, "No run starts with less free space in the data root", unit="MB", minimum=0)
    association_tolerance_s: float = setting(0.01, "Largest gap between matched timestamps", unit="s", minimum=0)
    gap_threshold_s: float = setting(
        1.0, "A longer time without a pose of the estimate is a gap", unit="s", minimum=0.001
    )
    variant_cache_bytes: int = setting(
        50_000_000_000, "Room for pre-processed variants of datasets; unused ones go", unit="bytes", minimum=0
    )
    uploads_max_bytes: int = setting(
        100_000_000_000, "Most that uploads may have together; 0 means no uploads", unit="bytes", minimum=0
    )
    requests_memory_mb: int = setting(
        500, "Most memory that checks of submissions on the web use together", unit="MB", minimum=50
    )
    requests_disk_mb: int = setting(
        2000, "Most that temporary files of all requests of the web server have together", unit="MB", minimum=50
    )
    analysis_max_runs: int = setting(200_000, "Most runs of one analysis on the web", minimum=1)
    analysis_time_limit_s: float = setting(600.0, "Longest that one analysis may compute", unit="s", minimum=1)
    analysis_memory_mb: int = setting(4000, "Most address space of a process that computes one", unit="MB", minimum=500)
    analyses_max_stored: int = setting(
        500, "View-only mode keeps so many analyses of visitors; the oldest go. Those of the owner stay", minimum=1
    )
    analyses_per_hour_per_address: int = setting(
        20, "View-only mode takes so many analyses an hour from one network address", minimum=1
    )
    no_new_analysis: bool = setting(False, "View-only mode takes no analyses of visitors: true or false")
    orb_vocabulary: str = setting("", "ORB vocabulary file for ORB-SLAM2 and 3; empty means the small one of the image")
    source_archives: str = setting(
        "", "Folder with sources as NAME-COMMIT.tar.xz for building images offline; empty means their repositories"
    )

    further: Mapping[str, str] = field(default_factory=dict, repr=False)

    def with_values(self, values: Mapping[str, Any]) -> Settings:
        """The same settings with these values."""
        return replace(self, **values)

    @property
    def effective_database_url(self) -> str:
        """The URL in force: the one given, or SQLite in the data root."""
        return self.database_url or f"sqlite:///{self.data / 'slamhive.db'}"

    @property
    def datasets_folder(self) -> Path:
        """Where imported datasets lie."""
        return self.data / "datasets"

    @property
    def variants_folder(self) -> Path:
        """Where pre-processed variants of datasets lie."""
        return self.data / "variants"

    @property
    def experiments_folder(self) -> Path:
        """Where the files of experiments lie."""
        return self.data / "experiments"

    @property
    def versions_folder(self) -> Path:
        """Where the folders of packages are kept as they were, version by version."""
        return self.data / "versions"

    @property
    def algorithms_folder(self) -> Path:
        """Where imported algorithm packages lie."""
        return self.data / "algorithms"

    @property
    def ledger_folder(self) -> Path:
        """Where facts are recorded that only the database knows otherwise."""
        return self.data / "ledger"

    @property
    def analyses_folder(self) -> Path:
        """Where stored analyses lie."""
        return self.data / "analyses"

    @property
    def baselines_folder(self) -> Path:
        """Where the baselines of gates lie."""
        return self.data / "baselines"

    @property
    def bisections_folder(self) -> Path:
        """Where searches for bad commits remember what they have built."""
        return self.data / "bisections"

    @property
    def challenges_folder(self) -> Path:
        """Where challenges lie, their secret ground truth included."""
        return self.data / "challenges"

    @property
    def claims_folder(self) -> Path:
        """Where the answers about claims of papers lie."""
        return self.data / "claims"

    @property
    def clouds_folder(self) -> Path:
        """Where the records of rented clusters lie."""
        return self.data / "clouds"

    @property
    def trash_folder(self) -> Path:
        """Where deleted runs lie until the trash is emptied."""
        return self.data / "trash"

    @property
    def answers_folder(self) -> Path:
        """Where answers to requests with an ``Idempotency-Key`` lie for a day."""
        return self.ledger_folder / "answers"

    @property
    def uploads_folder(self) -> Path:
        """Where files lie that programs send, until they are imported."""
        return self.data / "uploads"

    @property
    def runs_folder(self) -> Path:
        """Where run folders lie."""
        return self.data / "runs"


SETTINGS: Mapping[str, SettingKind] = {
    entry.name: entry.metadata[SettingKind] for entry in fields(Settings) if entry.metadata
}
"""What each setting may be, by the name of its field, in order of definition."""
