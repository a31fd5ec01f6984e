//! The description of the API, made from the handlers: `/v1/openapi.json`.

use axum::Json;
use utoipa::openapi::security::{Http, HttpAuthScheme, SecurityScheme};
use utoipa::{Modify, OpenApi};

use crate::error::Problem;
#[cfg(feature = "networks")]
use crate::teachings;
use crate::{access, health, jobs, objects, tasks};

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Sixfold",
        description = "6D poses of known objects, and grasps. Lengths are metres; poses are 4x4 matrices, \
             row by row, that \
                       transform points of the object's (or gripper's) frame into the camera's: x right, y down, z forward. \
                       Long requests become jobs: 202 with links to events, result and overlay."
    ),
    paths(
        health::health,
        health::methods,
        access::session,
        openapi,
        objects::list_objects,
        objects::get_object,
        objects::object_thumbnail,
        objects::object_mesh,
        objects::delete_object,
        tasks::object::add_object,
        tasks::find::find,
        tasks::grasps::grasps,
        jobs::list_jobs,
        jobs::get_job,
        jobs::delete_job,
        jobs::cancel_job,
        jobs::job_result,
        jobs::job_overlay,
        jobs::job_events,
    ),
    components(schemas(Problem)),
    modifiers(&Security),
    security(("token" = [])),
    tags(
        (name = "server", description = "The server itself"),
        (name = "objects", description = "Stored objects"),
        (name = "find", description = "Poses of stored objects in an image"),
        (name = "grasps", description = "Grasps on a depth image"),
        (name = "jobs", description = "Accepted requests, their state and results"),
    )
)]
struct Description;

/// The parts of the API that need networks.
#[cfg(feature = "networks")]
#[derive(OpenApi)]
#[openapi(
    paths(
        tasks::train::train_object,
        teachings::list_teachings,
        teachings::add_teaching,
        teachings::get_teaching,
        teachings::delete_teaching,
        teachings::add_photographs,
        teachings::run_teaching,
        teachings::accept_teaching,
        teachings::teaching_mesh,
        teachings::photograph_image,
        teachings::photograph_overlay,
        teachings::photograph_mask,
        teachings::set_pose,
        teachings::set_mask,
        teachings::set_left_out,
        teachings::forget_corrections,
    ),
    tags((name = "teachings", description = "Objects learned from photographs, on the printed board or without one"))
)]
struct WithNetworks;

#[cfg(feature = "networks")]
fn description() -> utoipa::openapi::OpenApi {
    let mut all = Description::openapi();
    all.merge(WithNetworks::openapi());
    all
}

#[cfg(not(feature = "networks"))]
fn description() -> utoipa::openapi::OpenApi {
    Description::openapi()
}

struct Security;

impl Modify for Security {
    fn modify(&self, api: &mut utoipa::openapi::OpenApi) {
        let scheme = SecurityScheme::Http(Http::new(HttpAuthScheme::Bearer));
        api.components.get_or_insert_default().add_security_scheme("token", scheme);
    }
}

/// This description.
#[utoipa::path(get, path = "/v1/openapi.json", tag = "server", responses(
    (status = 200, description = "OpenAPI 3.1", body = serde_json::Value),
))]
pub(crate) async fn openapi() -> Json<utoipa::openapi::OpenApi> {
    Json(description())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_is_described_with_its_problems() {
        let text = description().to_json().unwrap();
        for path in ["/v1/find", "/v1/grasps", "/v1/objects/{name}/mesh.ply", "/v1/jobs/{id}/events"] {
            assert!(text.contains(path), "{path}");
        }
        assert!(text.contains("multipart/form-data") && text.contains("#/components/schemas/Problem"));
    }
}
