//! The server: one address, a limited number of connections, and a shutdown that loses nothing.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use axum::Router;
use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::routing::{get, post};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::Runtime;
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

use crate::app::App;
use crate::error::{ApiError, ServeError};
use crate::options::ServerOptions;
use crate::{access, health, jobs, objects, openapi, pages, tasks};

/// Longest time for the head of a request to arrive.
const HEAD_TIMEOUT: Duration = Duration::from_secs(15);
/// How long the server waits at shutdown for answers that are being sent.
const LAST_ANSWERS: Duration = Duration::from_secs(3);
/// Interval at which the caller's request to stop is checked.
const POLL: Duration = Duration::from_millis(50);
/// A pause after the system refused a connection, for example for lack of file descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// A server that listens. It answers until it is stopped or dropped.
pub struct Server {
    address: SocketAddr,
    app: Arc<App>,
    workers: Vec<JoinHandle<()>>,
    runtime: Option<Runtime>,
    stop: Arc<Notify>,
}

impl Server {
    /// Starts listening, and starts processing the jobs that wait in the data folder.
    ///
    /// # Errors
    /// [`ServeError`].
    pub fn start(options: ServerOptions) -> Result<Server, ServeError> {
        options.check()?;
        let wanted = SocketAddr::new(options.host, options.port);
        let bind = |source| ServeError::Bind { address: wanted, source };
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .map_err(|source| ServeError::Io { path: options.data.clone(), source })?;
        // Before any job is processed, so that a second server on the same port does nothing.
        let listener = runtime.block_on(TcpListener::bind(wanted)).map_err(bind)?;
        let address = listener.local_addr().map_err(bind)?;
        let (number, connections) = (options.workers.get(), options.max_connections);
        let app = Arc::new(App::new(options)?);
        let worker = app.clone();
        let workers = app.jobs.start(number, Arc::new(move |work| worker.run(work)));
        let stop = Arc::new(Notify::new());
        runtime.spawn(accept(listener, router(app.clone()), connections, stop.clone()));
        Ok(Server { address, app, workers, runtime: Some(runtime), stop })
    }

    /// The address on which it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Answers requests until `stop` is set, then ends: a running job waits for the next server.
    pub fn run_until(self, stop: &AtomicBool) {
        while !stop.load(Ordering::SeqCst) {
            std::thread::sleep(POLL);
        }
    }

    fn end(&mut self) {
        self.app.jobs.end();
        self.stop.notify_one();
        for worker in self.workers.drain(..) {
            // Workers catch the panics of their jobs; other failures do not matter at this point.
            let _ = worker.join();
        }
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(LAST_ANSWERS);
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}

/// Accepts connections, at most `connections` at once, until it is asked to stop.
async fn accept(listener: TcpListener, router: Router, connections: usize, stop: Arc<Notify>) {
    let slots = Arc::new(Semaphore::new(connections));
    loop {
        let Ok(slot) = slots.clone().acquire_owned().await else { return };
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = stop.notified() => return,
        };
        match accepted {
            Ok((stream, _)) => {
                tokio::spawn(connection(stream, router.clone(), slot));
            }
            Err(_) => tokio::time::sleep(PAUSE).await,
        }
    }
}

/// Answers the requests of one connection.
async fn connection(stream: TcpStream, router: Router, slot: OwnedSemaphorePermit) {
    // Send small answers immediately.
    let _ = stream.set_nodelay(true);
    let mut builder = http1::Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(HEAD_TIMEOUT);
    // A client that disconnects during a request causes an error that can be ignored.
    let _ = builder.serve_connection(TokioIo::new(stream), TowerToHyperService::new(router)).await;
    drop(slot);
}

fn router(app: Arc<App>) -> Router {
    let max_upload = app.options.max_upload;
    Router::new()
        .route("/v1/health", get(health::health))
        .route("/v1/methods", get(health::methods))
        .route("/v1/openapi.json", get(openapi::openapi))
        .route("/v1/session", post(access::session))
        .route("/v1/objects", get(objects::list_objects).post(tasks::object::add_object))
        .route("/v1/objects/{name}", get(objects::get_object).delete(objects::delete_object))
        .route("/v1/objects/{name}/thumbnail.png", get(objects::object_thumbnail))
        .route("/v1/objects/{name}/mesh.ply", get(objects::object_mesh))
        .route("/v1/find", post(tasks::find::find))
        .route("/v1/grasps", post(tasks::grasps::grasps))
        .route("/v1/jobs", get(jobs::list_jobs))
        .route("/v1/jobs/{id}", get(jobs::get_job).delete(jobs::delete_job))
        .route("/v1/jobs/{id}/cancel", post(jobs::cancel_job))
        .route("/v1/jobs/{id}/result", get(jobs::job_result))
        .route("/v1/jobs/{id}/overlay.png", get(jobs::job_overlay))
        .route("/v1/jobs/{id}/events", get(jobs::job_events))
        .merge(teaching_routes())
        .merge(pages::routes())
        .fallback(not_there)
        .method_not_allowed_fallback(not_allowed)
        .layer(DefaultBodyLimit::max(max_upload))
        .layer(axum::middleware::from_fn_with_state(app.clone(), access::guard))
        .with_state(app)
}

#[cfg(feature = "networks")]
fn teaching_routes() -> Router<Arc<App>> {
    use axum::routing::{delete, put};

    use crate::teachings as t;
    let photograph = Router::new()
        .route("/image.jpg", get(t::photograph_image))
        .route("/overlay.jpg", get(t::photograph_overlay))
        .route("/mask.png", get(t::photograph_mask))
        .route("/pose", put(t::set_pose))
        .route("/mask", put(t::set_mask))
        .route("/left_out", put(t::set_left_out))
        .route("/corrections", delete(t::forget_corrections));
    Router::new()
        .route("/v1/objects/{name}/training", post(tasks::train::train_object))
        .route("/v1/teachings", get(t::list_teachings).post(t::add_teaching))
        .route("/v1/teachings/{id}", get(t::get_teaching).delete(t::delete_teaching))
        .route("/v1/teachings/{id}/photographs", post(t::add_photographs))
        .route("/v1/teachings/{id}/run", post(t::run_teaching))
        .route("/v1/teachings/{id}/accept", post(t::accept_teaching))
        .route("/v1/teachings/{id}/mesh.ply", get(t::teaching_mesh))
        .nest("/v1/teachings/{id}/photographs/{number}", photograph)
}

#[cfg(not(feature = "networks"))]
fn teaching_routes() -> Router<Arc<App>> {
    Router::new()
}

async fn not_there() -> ApiError {
    let advice = "the pages begin at /, the API is described in /v1/openapi.json";
    ApiError::plain(StatusCode::NOT_FOUND, "there is nothing at this path", advice)
}

async fn not_allowed() -> ApiError {
    let advice = "see /v1/openapi.json for the methods of this path";
    ApiError::plain(StatusCode::METHOD_NOT_ALLOWED, "this path does not take this method", advice)
}
