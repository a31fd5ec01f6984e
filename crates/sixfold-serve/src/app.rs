//! The state that all requests share: the store, the queue of jobs, and the methods and objects that are kept
//! in memory.

use std::sync::Arc;

use sixfold_estimator::ObjectStore;
use tokio::sync::Semaphore;

use crate::error::{Answer, ApiError, ServeError};
use crate::jobs::{Jobs, Stopped, Work};
use crate::methods::Methods;
use crate::objects::Thumbnails;
use crate::options::ServerOptions;
#[cfg(feature = "networks")]
use crate::teachings::Teachings;

/// Maximum number of uploads held in memory at once, and of images decoded at once for checks.
const UPLOADS: usize = 8;
const DECODERS: usize = 2;

/// The server's state.
pub(crate) struct App {
    pub options: ServerOptions,
    pub store: ObjectStore,
    pub jobs: Arc<Jobs>,
    #[cfg(feature = "networks")]
    pub teachings: Teachings,
    pub methods: Methods,
    pub thumbnails: Thumbnails,
    pub uploads: Semaphore,
    decoders: Semaphore,
}

/// The state as handlers receive it.
pub(crate) type Shared = axum::extract::State<Arc<App>>;

impl App {
    pub fn new(options: ServerOptions) -> Result<App, ServeError> {
        let store = ObjectStore::new(&options.objects);
        Ok(App {
            jobs: Arc::new(Jobs::open(&options)?),
            #[cfg(feature = "networks")]
            teachings: Teachings::open(&options)?,
            methods: Methods::new(store.clone(), options.objects.clone(), options.pix2pose.clone())?,
            store,
            thumbnails: Thumbnails::default(),
            uploads: Semaphore::new(UPLOADS),
            decoders: Semaphore::new(DECODERS),
            options,
        })
    }

    /// Works on one job.
    pub fn run(&self, work: &mut Work<'_>) -> Result<serde_json::Value, Stopped> {
        crate::tasks::run(self, work)
    }

    /// Runs computations and file access outside the threads that answer requests, a few at a time.
    pub async fn blocking<T: Send + 'static>(
        self: &Arc<App>,
        work: impl FnOnce(&App) -> Answer<T> + Send + 'static,
    ) -> Answer<T> {
        let fault = |e: &dyn std::fmt::Display| ApiError::system("the request met a fault of the program", e);
        let permit = self.decoders.acquire().await.map_err(|e| fault(&e))?;
        let app = self.clone();
        let result = tokio::task::spawn_blocking(move || work(&app)).await;
        drop(permit);
        result.map_err(|e| fault(&e))?
    }
}
