//! The experience store on a PostgreSQL server with pgvector: shared by several robots.
//!
//! The tables are those of the file, in a schema `sixfold`, with the features as `vector(256)`. Writers are serialised by an
//! advisory lock within their transaction. Without it two of them could commit in another order than that of their numbers, and a
//! reader that has already read the higher number would never read the lower one.
//!
//! The connection is not encrypted: over an untrusted network it needs a tunnel. The password itself is never sent: a server that
//! requests it in clear text is refused.

use std::cell::{Cell, RefCell};
use std::error::Error as _;
use std::fmt;
use std::path::PathBuf;
use std::time::Duration;

use postgres::config::{Host, SslMode, SslNegotiation};
use postgres::error::SqlState;
use postgres::{Client, Config, Error, IsolationLevel, NoTls, Row, Transaction};

use super::encode::{self, Images};
use super::experience::{Copy, Experience, Stored};
use super::index::{Match, distance};
use super::password_guard::{ASKED, PasswordGuard};
use super::place::{address, shown};
use super::row::{self, Raw};
use super::{AttemptRow, Changes, ExperienceStore, Position, StoreError, StoredFeature, Summary, TaskRecord};
use crate::Attempt;
use crate::FEATURE;

/// Marks a schema `sixfold` as created by this program.
const APPLICATION: &str = "sixfold experiences";
/// Version of the tables.
const VERSION: i64 = 1;
/// The advisory lock that writers take: "6fEx", 1.
const LOCK: &str = "SELECT pg_advisory_xact_lock(3919896907370987521)";
const TABLES: &str = "
    CREATE TABLE sixfold.store (
        one boolean PRIMARY KEY DEFAULT true CHECK (one), application text NOT NULL, version bigint NOT NULL,
        identity text NOT NULL);
    CREATE TABLE sixfold.experience (
        id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY, key bytea NOT NULL UNIQUE, time bigint NOT NULL,
        object text NOT NULL, part text, gripper text NOT NULL, opening double precision NOT NULL,
        width double precision NOT NULL, camera_from_gripper bytea NOT NULL, camera bytea NOT NULL, side bigint NOT NULL,
        extent bytea NOT NULL, depth bytea NOT NULL, normals bytea NOT NULL, vd_noc bytea NOT NULL, region bytea NOT NULL,
        network text NOT NULL, provenance text NOT NULL, table_plane bytea);
    CREATE TABLE sixfold.feature (
        id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY,
        experience bigint NOT NULL REFERENCES sixfold.experience(id) ON DELETE CASCADE,
        angle double precision NOT NULL, feature vector(256) NOT NULL);
    CREATE INDEX feature_of_experience ON sixfold.feature(experience);
    CREATE TABLE sixfold.removal (id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY, experience bigint NOT NULL);
    CREATE TABLE sixfold.attempt (
        id bigint GENERATED ALWAYS AS IDENTITY PRIMARY KEY, key bytea NOT NULL UNIQUE, attempt text NOT NULL);
";

/// A store on a server. A lost connection is reopened at the next call.
pub struct PostgresStore {
    config: Config,
    /// The address without the password.
    server: String,
    /// Whether to create a store in a database without one.
    make: bool,
    client: RefCell<Option<Client>>,
    /// Identity of the store that answered first.
    identity: RefCell<Option<String>>,
    /// Number of connections opened.
    connections: Cell<u64>,
}

impl fmt::Debug for PostgresStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "PostgresStore({})", self.server)
    }
}

/// Whether a transaction reads or writes.
#[derive(Clone, Copy, PartialEq)]
enum Access {
    Read,
    Write,
}

/// Why a transaction failed.
enum Failure {
    /// It did not begin: nothing was changed.
    NotStarted(Error),
    Failed(Error),
}

impl PostgresStore {
    /// A store at an address, `postgres://user@host:port/database`, without contacting it yet. The first call that reaches the
    /// server creates the tables if there are none. Without a password in the address the environment variable PGPASSWORD is used.
    ///
    /// # Errors
    /// [`StoreError::Address`].
    pub fn at(url: &str) -> Result<PostgresStore, StoreError> {
        let server = shown(url);
        let wrong = |reason: &str| StoreError::Address { server: server.clone(), reason: reason.to_owned() };
        if url.matches('@').count() > 1 {
            return Err(wrong("there is more than one @; within a password it is written %40"));
        }
        let url = address(url).map_err(|reason| wrong(&reason))?;
        let mut config: Config = url.parse().map_err(|e: Error| {
            // Its cause names a parameter, never a value.
            wrong(&e.source().map_or_else(|| e.to_string(), |cause| format!("{e}: {cause}")))
        })?;
        if config.get_hosts().is_empty() && config.get_hostaddrs().is_empty() {
            return Err(wrong("there is no host"));
        }
        if config.get_ssl_mode() == SslMode::Require {
            return Err(wrong(
                "sslmode=require: this program cannot encrypt the connection; lead it through a tunnel (ssh -L 5432:localhost:5432 HOST) or a network you trust, and leave sslmode out",
            ));
        }
        if config.get_password().is_none()
            && let Ok(password) = std::env::var("PGPASSWORD")
        {
            config.password(password);
        }
        if config.get_connect_timeout().is_none() {
            config.connect_timeout(Duration::from_secs(5));
        }
        // A server that disappears without closing the connection is detected after half a minute.
        config
            .application_name("sixfold")
            .tcp_user_timeout(Duration::from_secs(20))
            .keepalives_idle(Duration::from_secs(10))
            .keepalives_interval(Duration::from_secs(5))
            .keepalives_retries(3);
        Ok(PostgresStore {
            config,
            server,
            make: true,
            client: RefCell::new(None),
            identity: RefCell::new(None),
            connections: Cell::new(0),
        })
    }

    /// Opens a store, or creates an empty one in a database without one.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn create(url: &str) -> Result<PostgresStore, StoreError> {
        let store = Self::at(url)?;
        *store.client.borrow_mut() = Some(store.connect()?);
        Ok(store)
    }

    /// Opens an existing store.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn open(url: &str) -> Result<PostgresStore, StoreError> {
        let store = PostgresStore { make: false, ..Self::at(url)? };
        *store.client.borrow_mut() = Some(store.connect()?);
        Ok(store)
    }

    /// Number of connections opened, including lost ones.
    pub fn connections(&self) -> u64 {
        self.connections.get()
    }

    /// The `count` nearest features of a network, searched on the server, nearest first and ties in the order in which they were
    /// stored; with `part`, only of experiences with that part. The result is that of [`super::FeatureIndex::nearest`], for robots
    /// that cannot keep all features in memory.
    ///
    /// The server compares all features in `f32`; those that may be among the nearest are compared again here, in `f64`.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn nearest(
        &self,
        network: &str,
        feature: &[f32],
        count: usize,
        part: Option<&str>,
    ) -> Result<Vec<Match>, StoreError> {
        // The relative error of 256 rounded terms is at most 256 / 2^24, about a hundred thousandth.
        const NEAREST: &str = "
            WITH seen AS MATERIALIZED (
                SELECT f.id, f.experience, f.angle, f.feature <-> $1::real[]::vector AS distance
                FROM sixfold.feature f JOIN sixfold.experience e ON e.id = f.experience
                WHERE e.network = $2 AND ($3::text IS NULL OR e.part = $3)),
            near AS (SELECT distance FROM seen ORDER BY distance LIMIT $4)
            SELECT seen.experience, seen.angle, f.feature::real[]
            FROM seen JOIN sixfold.feature f ON f.id = seen.id
            WHERE seen.distance <= (SELECT max(distance) FROM near) * 1.0001 + 1e-6 ORDER BY seen.id";
        if feature.len() != FEATURE || count == 0 {
            return Ok(vec![]);
        }
        let mut found = self.transaction(Access::Read, |t| {
            t.query(NEAREST, &[&feature, &network, &part, &(count as i64)])?
                .iter()
                .map(|row| {
                    let other: Vec<f32> = row.try_get(2)?;
                    let distance = distance(&other, feature);
                    Ok(Match { experience: row.try_get(0)?, angle: row.try_get(1)?, distance })
                })
                .collect::<Result<Vec<Match>, Error>>()
        })?;
        found.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        found.truncate(count);
        Ok(found)
    }

    /// A connection on which no password is sent in clear text.
    fn dial(&self) -> Result<Client, Error> {
        let mut config = self.config.clone();
        if config.get_hosts().iter().any(|host| !matches!(host, Host::Tcp(_))) {
            // A Unix socket, on which nobody can eavesdrop.
            return config.connect(NoTls);
        }
        if config.get_hosts().is_empty() {
            for address in config.get_hostaddrs().to_vec() {
                config.host(&address.to_string());
            }
        }
        // This does not enable encryption; it makes the client library use the wrapper around the connection.
        config.ssl_mode(SslMode::Require).ssl_negotiation(SslNegotiation::Direct).connect(PasswordGuard)
    }

    fn connect(&self) -> Result<Client, StoreError> {
        let mut client = self.dial().map_err(|e| match self.error(&e) {
            // No request was sent yet.
            StoreError::Lost { server, reason } => StoreError::Unreachable { server, reason },
            error => error,
        })?;
        self.connections.set(self.connections.get() + 1);
        let said = client
            .batch_execute(
                "SET lock_timeout = '20s'; SET idle_in_transaction_session_timeout = '60s';
                 SELECT set_config('synchronous_commit', 'on', false) WHERE current_setting('synchronous_commit') = 'off'",
            )
            .map_err(|e| self.error(&e));
        said.and_then(|()| self.find_tables(&mut client)).map_err(|error| match error {
            StoreError::Lost { server, reason } => StoreError::Unreachable { server, reason },
            error => error,
        })?;
        Ok(client)
    }

    /// Tests that the store exists and was created by this program, or creates it.
    fn find_tables(&self, client: &mut Client) -> Result<(), StoreError> {
        let found = self.state(client)?;
        if !found.schema_used && !found.store {
            let known = self.identity.borrow().is_some();
            if known || !self.make {
                return Err(StoreError::Open {
                    file: self.place(),
                    reason: "the database holds none; `sixfold grasp learn`, `sixfold grasp store add` and `sixfold grasp store merge` make one".to_owned(),
                });
            }
            self.make_tables(client)?;
        }
        let found = self.state(client)?;
        if !found.store {
            let found = "a schema `sixfold` with other tables".to_owned();
            return Err(StoreError::NotAStore { file: self.place(), found });
        }
        let row = client
            .query_opt("SELECT application, version, identity FROM sixfold.store", &[])
            .and_then(|row| row.map(|r| Ok((r.try_get(0)?, r.try_get(1)?, r.try_get(2)?))).transpose());
        let (application, version, identity): (String, i64, String) = match row {
            Ok(Some(row)) => row,
            Err(e) if passes(&e) || e.code() == Some(&SqlState::INSUFFICIENT_PRIVILEGE) => {
                return Err(self.error(&e));
            }
            _ => (String::new(), 0, String::new()),
        };
        if application != APPLICATION {
            let found = "a table `sixfold.store` of another program".to_owned();
            return Err(StoreError::NotAStore { file: self.place(), found });
        }
        if version != VERSION {
            return Err(StoreError::Version { file: self.place(), found: version, expected: VERSION });
        }
        let Some(extension) = found.extension else {
            return Err(self.no_extension("it was dropped"));
        };
        let mut known = self.identity.borrow_mut();
        if known.as_ref().is_some_and(|k| *k != identity) {
            let found = "another store than before".to_owned();
            return Err(StoreError::NotAStore { file: self.place(), found });
        }
        *known = Some(identity);
        // The type and its operators are in the extension's schema.
        client.batch_execute(&format!("SET search_path = sixfold, {extension}")).map_err(|e| self.error(&e))
    }

    fn state(&self, client: &mut Client) -> Result<State, StoreError> {
        const STATE: &str = "
            SELECT EXISTS (SELECT FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace WHERE n.nspname = 'sixfold'),
                EXISTS (SELECT FROM pg_class c JOIN pg_namespace n ON n.oid = c.relnamespace
                    WHERE n.nspname = 'sixfold' AND c.relname = 'store'),
                EXISTS (SELECT FROM pg_namespace WHERE nspname = 'sixfold'),
                (SELECT quote_ident(n.nspname) FROM pg_extension e JOIN pg_namespace n ON n.oid = e.extnamespace
                    WHERE e.extname = 'vector')";
        let read = client.query_one(STATE, &[]).and_then(|row| {
            Ok(State {
                schema_used: row.try_get(0)?,
                store: row.try_get(1)?,
                schema: row.try_get(2)?,
                extension: row.try_get(3)?,
            })
        });
        read.map_err(|e| self.error(&e))
    }

    fn make_tables(&self, client: &mut Client) -> Result<(), StoreError> {
        // Two robots may both find no tables: the lock decides which one creates them.
        client
            .batch_execute("BEGIN")
            .and_then(|()| client.batch_execute(LOCK))
            .map_err(|e| self.error(&e))?;
        let found = self.state(client)?;
        if !found.store && !found.schema_used {
            if found.extension.is_none() {
                let offered = client
                    .query_opt("SELECT 1 FROM pg_available_extensions WHERE name = 'vector'", &[])
                    .map_err(|e| self.error(&e))?;
                if offered.is_none() {
                    return Err(self.no_extension("the server does not have it"));
                }
                client.batch_execute("CREATE EXTENSION vector").map_err(|e| match e.code() {
                    Some(&SqlState::INSUFFICIENT_PRIVILEGE) => {
                        self.no_extension("the server has it, this user may not switch it on")
                    }
                    _ => self.error(&e),
                })?;
            }
            let extension = self.state(client)?.extension.unwrap_or_default();
            let schema = if found.schema { "" } else { "CREATE SCHEMA sixfold;" };
            client
                .batch_execute(&format!("SET LOCAL search_path = {extension}; {schema} {TABLES}"))
                .and_then(|()| {
                    client.execute(
                        "INSERT INTO sixfold.store (application, version, identity)
                         VALUES ($1, $2, gen_random_uuid()::text)",
                        &[&APPLICATION, &VERSION],
                    )
                })
                .map_err(|e| self.error(&e))?;
        }
        client.batch_execute("COMMIT").map_err(|e| self.error(&e))
    }

    fn no_extension(&self, reason: &str) -> StoreError {
        StoreError::Extension { server: self.server.clone(), reason: reason.to_owned() }
    }

    /// The path for error variants that files and servers share.
    fn place(&self) -> PathBuf {
        PathBuf::from(&self.server)
    }

    /// Runs `work` in one transaction.
    fn transaction<T>(
        &self,
        access: Access,
        work: impl Fn(&mut Transaction<'_>) -> Result<T, Error>,
    ) -> Result<T, StoreError> {
        let mut kept = self.client.borrow_mut();
        let mut client = match kept.take().filter(|c| !c.is_closed()) {
            Some(client) => client,
            None => self.connect()?,
        };
        let mut done = attempt(&mut client, access, &work);
        // A connection that was lost while idle fails here, before anything was changed, so the work is repeated with a new one.
        if let Err(Failure::NotStarted(error)) = &done
            && is_lost(error)
        {
            drop(client);
            client = self.connect()?;
            done = attempt(&mut client, access, &work);
        }
        match done {
            Ok(value) => {
                *kept = Some(client);
                Ok(value)
            }
            Err(Failure::NotStarted(error) | Failure::Failed(error)) => {
                if !is_lost(&error) {
                    *kept = Some(client);
                }
                Err(self.error(&error))
            }
        }
    }

    /// Converts PostgreSQL's errors.
    fn error(&self, error: &Error) -> StoreError {
        let (server, file) = (self.server.clone(), self.place());
        let reason = match (error.as_db_error(), error.source()) {
            (Some(db), _) => db.message().to_owned(),
            (None, Some(cause)) => format!("{error}: {cause}"),
            (None, None) => error.to_string(),
        };
        if reason.ends_with(ASKED) {
            return StoreError::Refused { server, reason: ASKED.to_owned() };
        }
        if is_lost(error) {
            return StoreError::Lost { server, reason };
        }
        let Some(code) = error.code() else { return self.without_code(error, reason) };
        match code {
            &SqlState::TOO_MANY_CONNECTIONS => StoreError::Unreachable { server, reason },
            &SqlState::DISK_FULL => StoreError::Full { file },
            &SqlState::LOCK_NOT_AVAILABLE | &SqlState::T_R_DEADLOCK_DETECTED => StoreError::Busy { file },
            &SqlState::READ_ONLY_SQL_TRANSACTION => StoreError::ReadOnly { file },
            &SqlState::INSUFFICIENT_PRIVILEGE | &SqlState::INVALID_CATALOG_NAME => {
                StoreError::Refused { server, reason }
            }
            code if code.code().starts_with("28") => StoreError::Refused { server, reason },
            _ => StoreError::Other { file, reason },
        }
    }

    /// Errors of the client library: any error before the first answer of the server means that it is unreachable.
    fn without_code(&self, error: &Error, reason: String) -> StoreError {
        let server = self.server.clone();
        match error.to_string().as_str() {
            "authentication error" | "invalid configuration" => StoreError::Refused { server, reason },
            _ => StoreError::Other { file: self.place(), reason },
        }
    }
}

/// Which of our tables a database has.
struct State {
    /// The schema `sixfold` is not empty.
    schema_used: bool,
    /// The table `sixfold.store` exists.
    store: bool,
    /// The schema exists.
    schema: bool,
    /// The schema of pgvector, quoted.
    extension: Option<String>,
}

fn attempt<T>(
    client: &mut Client,
    access: Access,
    work: &impl Fn(&mut Transaction<'_>) -> Result<T, Error>,
) -> Result<T, Failure> {
    let begin = match access {
        // All reads of one call must be consistent.
        Access::Read => {
            client.build_transaction().isolation_level(IsolationLevel::RepeatableRead).read_only(true)
        }
        // With this level, reads after waiting for the lock include everything committed before it was acquired.
        Access::Write => client.build_transaction().isolation_level(IsolationLevel::ReadCommitted),
    };
    let mut transaction = begin.start().map_err(Failure::NotStarted)?;
    if access == Access::Write {
        transaction.batch_execute(LOCK).map_err(Failure::Failed)?;
    }
    let value = work(&mut transaction).map_err(Failure::Failed)?;
    transaction.commit().map_err(Failure::Failed)?;
    Ok(value)
}

/// Whether the server of this connection is gone or was never reached.
fn is_lost(error: &Error) -> bool {
    match error.code() {
        // Class 08: connection; 57P: the server is stopped, crashed, or starting; 25P03: it closed the idle connection.
        Some(code) => ["08", "57P", "25P03"].iter().any(|c| code.code().starts_with(c)),
        None => {
            let io = error.source().is_some_and(|cause| cause.is::<std::io::Error>());
            error.is_closed() || io || error.to_string() == "timeout waiting for server"
        }
    }
}

/// Whether it may succeed later.
fn passes(error: &Error) -> bool {
    is_lost(error) || error.code() == Some(&SqlState::TOO_MANY_CONNECTIONS)
}

fn raw(row: &Row) -> Result<Raw, Error> {
    Ok(Raw {
        time: row.try_get(0)?,
        object: row.try_get(1)?,
        part: row.try_get(2)?,
        gripper: row.try_get(3)?,
        opening: row.try_get(4)?,
        width: row.try_get(5)?,
        pose: row.try_get(6)?,
        camera: row.try_get(7)?,
        side: row.try_get(8)?,
        extent: row.try_get(9)?,
        images: Images { depth: row.try_get(10)?, normals: row.try_get(11)?, vd_noc: row.try_get(12)? },
        region: row.try_get(13)?,
        network: row.try_get(14)?,
        provenance: row.try_get(15)?,
        table_plane: row.try_get(16)?,
    })
}

/// An experience with its encoded images and key.
struct Prepared<'a> {
    experience: &'a Experience,
    images: Images,
    key: [u8; 16],
}

impl Prepared<'_> {
    /// Tests for values that the server would refuse.
    fn new(experience: &Experience) -> Result<Prepared<'_>, StoreError> {
        let (images, key) = row::prepare(experience)?;
        if let Some(copy) = experience.copies.iter().find(|c| c.feature.len() != FEATURE) {
            return Err(StoreError::Field {
                id: 0,
                field: "feature",
                expected: "256 numbers",
                found: copy.feature.len().to_string(),
            });
        }
        Ok(Prepared { experience, images, key })
    }

    /// Its number, and whether it is new.
    fn insert(&self, t: &mut Transaction<'_>) -> Result<(i64, bool), Error> {
        let Prepared { experience: e, images, key } = self;
        let key = key.as_slice();
        let gripper = row::gripper_text(&e.gripper);
        let pose = encode::pose(&e.camera_from_gripper);
        let camera = encode::camera(&e.crop.camera);
        let side = e.crop.side as i64;
        let extent = encode::vectors(&[e.crop.extent.centre, e.crop.extent.half]);
        let region = encode::bits(&e.region);
        let table_plane = e.crop.table.as_ref().map(encode::plane);
        let angles: Vec<f64> = e.copies.iter().map(|c| c.angle).collect();
        let features: Vec<f32> = e.copies.iter().flat_map(|c| c.feature.iter().copied()).collect();
        if let Some(row) = t.query_opt("SELECT id FROM experience WHERE key = $1", &[&key])? {
            return Ok((row.try_get(0)?, false));
        }
        let row = t.query_one(
            "INSERT INTO experience (key, time, object, part, gripper, opening, width, camera_from_gripper, camera, side,
             extent, depth, normals, vd_noc, region, network, provenance, table_plane)
             VALUES ($1,$2,$3,$4,$5,$6,$7,$8,$9,$10,$11,$12,$13,$14,$15,$16,$17,$18) RETURNING id",
            &[
                &key,
                &e.time,
                &e.object,
                &e.part,
                &gripper,
                &e.opening,
                &e.width,
                &pose,
                &camera,
                &side,
                &extent,
                &images.depth,
                &images.normals,
                &images.vd_noc,
                &region,
                &e.network,
                &e.provenance,
                &table_plane,
            ],
        )?;
        let id: i64 = row.try_get(0)?;
        t.execute(
            "INSERT INTO feature (experience, angle, feature)
             SELECT $1, ($2::double precision[])[k], (($3::real[])[256 * (k - 1) + 1 : 256 * k])::vector
             FROM generate_series(1, cardinality($2::double precision[])) k ORDER BY k",
            &[&id, &angles, &features],
        )?;
        Ok((id, true))
    }
}

fn insert_attempt(t: &mut Transaction<'_>, key: &[u8], text: &str) -> Result<u64, Error> {
    t.execute(
        "INSERT INTO attempt (key, attempt) SELECT $1, $2 WHERE NOT EXISTS (SELECT FROM attempt WHERE key = $1)",
        &[&key, &text],
    )
}

impl ExperienceStore for PostgresStore {
    fn add(&mut self, experience: &Experience) -> Result<(i64, bool), StoreError> {
        let prepared = Prepared::new(experience)?;
        self.transaction(Access::Write, |t| prepared.insert(t))
    }

    fn add_record(&mut self, record: &TaskRecord<'_>) -> Result<Option<i64>, StoreError> {
        if record.journal.is_some() {
            let reason = "a server keeps no journal, the robot's copy of its store does".to_owned();
            return Err(StoreError::Other { file: self.place(), reason });
        }
        let attempts = record.attempts.iter().map(encode::attempt).collect::<Result<Vec<_>, _>>()?;
        let prepared = record.experience.map(Prepared::new).transpose()?;
        self.transaction(Access::Write, |t| {
            for (key, text) in &attempts {
                insert_attempt(t, key, text)?;
            }
            prepared.as_ref().map(|prepared| Ok(prepared.insert(t)?.0)).transpose()
        })
    }

    fn get(&self, id: i64) -> Result<Option<Stored>, StoreError> {
        let read = self.transaction(Access::Read, |t| {
            let row = t.query_opt(
                "SELECT time, object, part, gripper, opening, width, camera_from_gripper, camera, side, extent, depth,
                 normals, vd_noc, region, network, provenance, table_plane FROM experience WHERE id = $1",
                &[&id],
            )?;
            let Some(row) = row else { return Ok(None) };
            let copies = t
                .query("SELECT angle, feature::real[] FROM feature WHERE experience = $1 ORDER BY id", &[&id])?
                .iter()
                .map(|row| Ok(Copy { angle: row.try_get(0)?, feature: row.try_get(1)? }))
                .collect::<Result<Vec<Copy>, Error>>()?;
            Ok(Some((raw(&row)?, copies)))
        })?;
        let Some((raw, copies)) = read else { return Ok(None) };
        Ok(Some(Stored { id, experience: raw.understand(id, copies)? }))
    }

    fn list(&self) -> Result<Vec<Summary>, StoreError> {
        self.transaction(Access::Read, |t| {
            t.query(
                "SELECT id, time, object, part, gripper, width, network, provenance FROM experience ORDER BY id",
                &[],
            )?
            .iter()
            .map(|row| {
                let gripper: String = row.try_get(4)?;
                Ok(Summary {
                    id: row.try_get(0)?,
                    time: row.try_get(1)?,
                    object: row.try_get(2)?,
                    part: row.try_get(3)?,
                    gripper: row::gripper_name(&gripper),
                    width: row.try_get(5)?,
                    network: row.try_get(6)?,
                    provenance: row.try_get(7)?,
                })
            })
            .collect()
        })
    }

    fn forget(&mut self, id: i64) -> Result<bool, StoreError> {
        self.transaction(Access::Write, |t| {
            let removed = t.execute("DELETE FROM experience WHERE id = $1", &[&id])? > 0;
            if removed {
                t.execute("INSERT INTO removal (experience) VALUES ($1)", &[&id])?;
            }
            Ok(removed)
        })
    }

    fn changes(&self, since: Position) -> Result<Changes, StoreError> {
        self.transaction(Access::Read, |t| {
            let mut changes = Changes { position: since, ..Changes::default() };
            let rows = t.query(
                "SELECT f.id, f.experience, f.angle, f.feature::real[], e.network FROM feature f
                 JOIN experience e ON e.id = f.experience WHERE f.id > $1 ORDER BY f.id",
                &[&since.feature],
            )?;
            for row in &rows {
                changes.position.feature = row.try_get(0)?;
                changes.features.push(StoredFeature {
                    experience: row.try_get(1)?,
                    angle: row.try_get(2)?,
                    feature: row.try_get(3)?,
                    network: row.try_get(4)?,
                });
            }
            let rows =
                t.query("SELECT id, experience FROM removal WHERE id > $1 ORDER BY id", &[&since.removal])?;
            for row in &rows {
                changes.position.removal = row.try_get(0)?;
                changes.forgotten.push(row.try_get(1)?);
            }
            Ok(changes)
        })
    }

    fn add_attempt(&mut self, attempt: &Attempt) -> Result<bool, StoreError> {
        let (key, text) = encode::attempt(attempt)?;
        self.transaction(Access::Write, |t| Ok(insert_attempt(t, &key, &text)? > 0))
    }

    fn attempts(&self, after: i64) -> Result<Vec<(i64, Attempt)>, StoreError> {
        let rows = self.attempt_rows(after)?.into_iter();
        Ok(rows.filter_map(|(id, attempt)| Some((id, attempt.ok()?))).collect())
    }

    fn attempt_rows(&self, after: i64) -> Result<Vec<AttemptRow>, StoreError> {
        let rows = self.transaction(Access::Read, |t| {
            t.query("SELECT id, attempt FROM attempt WHERE id > $1 ORDER BY id", &[&after])?
                .iter()
                .map(|row| Ok((row.try_get(0)?, row.try_get(1)?)))
                .collect::<Result<Vec<(i64, String)>, Error>>()
        })?;
        Ok(rows.into_iter().map(|(id, text)| (id, encode::from_attempt(id, &text))).collect())
    }

    fn forget_attempt(&mut self, id: i64) -> Result<bool, StoreError> {
        self.transaction(Access::Write, |t| Ok(t.execute("DELETE FROM attempt WHERE id = $1", &[&id])? > 0))
    }

    fn identity(&self) -> Result<Option<String>, StoreError> {
        if self.identity.borrow().is_none() {
            *self.client.borrow_mut() = Some(self.connect()?);
        }
        Ok(self.identity.borrow().clone())
    }
}
