//! Uploaded meshes: their format by the extension of the file's name, and files that they refer to.

use std::collections::HashMap;

use serde::{Deserialize, Serialize};
use sixfold_mesh::{Mesh, Unit, check_size, parse_gltf, parse_obj, parse_ply, parse_stl, parse_xyz};

use crate::error::{Answer, ApiError};
use crate::form::{Form, UploadedFile};

/// Maximum number of additional files of a mesh: materials and textures.
const MAX_RESOURCES: usize = 50;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum MeshFormat {
    Ply,
    Obj,
    Stl,
    Gltf,
    Xyz,
}

impl MeshFormat {
    /// The format by the extension of a file's name.
    pub fn of(name: &str) -> Answer<MeshFormat> {
        let ending = name.rsplit_once('.').map(|(_, ending)| ending.to_ascii_lowercase());
        Ok(match ending.as_deref() {
            Some("ply") => MeshFormat::Ply,
            Some("obj") => MeshFormat::Obj,
            Some("stl") => MeshFormat::Stl,
            Some("gltf" | "glb") => MeshFormat::Gltf,
            Some("xyz") => MeshFormat::Xyz,
            _ => {
                return Err(ApiError::field(
                    "mesh",
                    format!("a file named {name:?}"),
                    "a name that ends in .ply, .obj, .stl, .gltf, .glb or .xyz",
                    "convert the mesh to one of them; the file's extension gives the format",
                ));
            }
        })
    }

    /// The mesh in metres. Files that it refers to are searched only among the uploaded ones: `resource` reads the one with this
    /// index in `names`.
    pub fn parse(
        self,
        bytes: &[u8],
        unit: Unit,
        names: &[String],
        resource: &dyn Fn(usize) -> std::io::Result<Vec<u8>>,
    ) -> Answer<Mesh> {
        let parse = match self {
            MeshFormat::Ply => parse_ply,
            MeshFormat::Obj => parse_obj,
            MeshFormat::Stl => parse_stl,
            MeshFormat::Gltf => parse_gltf,
            MeshFormat::Xyz => parse_xyz,
        };
        let numbers: HashMap<&str, usize> =
            names.iter().enumerate().map(|(i, name)| (name.as_str(), i)).collect();
        let beside = |name: &str| match numbers.get(name) {
            Some(&i) => resource(i),
            None => Err(std::io::Error::new(
                std::io::ErrorKind::NotFound,
                "not among the uploaded files: send it as a field `resource`",
            )),
        };
        let wrong = |e: &dyn std::fmt::Display| {
            // The library's messages name the command line's options.
            let text = e.to_string().replace("--unit ", "unit=");
            ApiError::about(
                "mesh",
                text,
                "a mesh of an object of 5 mm to 5 m",
                "repair or convert the file, and check its unit",
            )
        };
        let mesh = parse(bytes, "mesh", unit, &beside).map_err(|e| wrong(&e))?;
        check_size(&mesh, "mesh", unit).map_err(|e| wrong(&e))?;
        Ok(mesh)
    }
}

/// The unit of a form's mesh, which has to be given.
pub(crate) fn mesh_unit(form: &Form) -> Answer<Unit> {
    let units = "one of m, cm, mm, in";
    form.parsed::<Unit>("unit", units)?.ok_or_else(|| {
        ApiError::field("unit", "nothing", units, "a mesh file does not say its unit: give it")
    })
}

/// The additional files of a form's mesh.
pub(crate) fn mesh_resources(form: &Form) -> Answer<&[UploadedFile]> {
    let resources = form.files("resource");
    if resources.len() > MAX_RESOURCES {
        return Err(ApiError::field(
            "resource",
            format!("{} files", resources.len()),
            format!("at most {MAX_RESOURCES}"),
            "join the textures, or send a GLB file",
        ));
    }
    Ok(resources)
}

/// The mesh of a form, if it has one, in metres.
#[cfg(feature = "networks")]
pub(crate) fn mesh_of_form(form: &Form) -> Answer<Option<Mesh>> {
    let Some(file) = form.file("mesh") else {
        let beside =
            [("unit", form.text("unit")?.is_some()), ("resource", !form.files("resource").is_empty())];
        return match beside.iter().find(|(_, sent)| *sent) {
            Some((name, _)) => {
                let advice = "send the mesh too, or leave it out";
                Err(ApiError::field(*name, "it without a mesh", "it with the file field mesh", advice))
            }
            None => Ok(None),
        };
    };
    let (unit, resources) = (mesh_unit(form)?, mesh_resources(form)?);
    let names: Vec<String> = resources.iter().map(|r| r.name.clone()).collect();
    let mesh =
        MeshFormat::of(&file.name)?.parse(&file.bytes, unit, &names, &|i| Ok(resources[i].bytes.to_vec()))?;
    Ok(Some(mesh))
}
