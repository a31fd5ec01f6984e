//! The physics engine with settings that make grasping realistic.
//!
//! Found by experiments: with Rapier's default softness of contacts (30 Hz) a light finger sinks millimetres into the object, its
//! default friction model solves one constraint for four contacts, and recycled contacts creep. Here contacts are stiff, friction
//! is Coulomb's at every contact, and none is recycled.

use nalgebra::{Quaternion, UnitQuaternion};
use rapier3d::dynamics::FrictionModel;
use rapier3d::math::{Pose as RapierPose, Rotation};
use rapier3d::prelude::*;
use sixfold_geometry::{Pose, Vec3};

use sixfold_geometry::nalgebra;

use crate::ConvexParts;
use crate::parts::{vec3, vector};

/// Collision groups: the object collides with everything; gripper and table do not collide with each other (this is tested before).
pub(crate) const OBJECT: InteractionGroups =
    InteractionGroups::new(Group::GROUP_1, Group::ALL, InteractionTestMode::And);
pub(crate) const GRIPPER: InteractionGroups =
    InteractionGroups::new(Group::GROUP_2, Group::GROUP_1, InteractionTestMode::And);
const TABLE: InteractionGroups =
    InteractionGroups::new(Group::GROUP_3, Group::GROUP_1, InteractionTestMode::And);

/// An empty world with a table top at `z = 0`.
pub(crate) fn world(time_step: f64, contact_frequency: f64, table_friction: f64) -> PhysicsWorld {
    let mut world = PhysicsWorld::new();
    world.gravity = Vector::new(0.0, 0.0, -9.81);
    let p = &mut world.integration_parameters;
    p.dt = time_step as f32;
    p.length_unit = 0.1;
    p.contact_softness.natural_frequency = contact_frequency as f32;
    p.static_contact_softness.natural_frequency = contact_frequency as f32;
    p.friction_model = FrictionModel::Coulomb;
    p.contact_recycling = false;
    let top = ColliderBuilder::cuboid(1.0, 1.0, 0.1)
        .friction(table_friction as f32)
        .friction_combine_rule(CoefficientCombineRule::Multiply)
        .collision_groups(TABLE);
    world.insert(RigidBodyBuilder::fixed().translation(Vector::new(0.0, 0.0, -0.1)), top);
    world
}

/// Puts the object into the world. Its friction coefficient is 1, so the product for a contact pair is the other body's
/// coefficient.
pub(crate) fn insert_object(
    world: &mut PhysicsWorld,
    parts: &ConvexParts,
    world_from_object: &Pose,
    mass: f64,
    damping: f64,
) -> (RigidBodyHandle, ColliderHandle) {
    let collider = ColliderBuilder::compound(parts.shapes())
        .mass(mass as f32)
        .friction(1.0)
        .friction_combine_rule(CoefficientCombineRule::Multiply)
        .collision_groups(OBJECT);
    let body = RigidBodyBuilder::dynamic()
        .pose(to_engine(world_from_object))
        .angular_damping(damping as f32)
        .linear_damping(0.25 * damping as f32)
        .can_sleep(false);
    world.insert(body, collider)
}

/// To the engine's pose.
pub(crate) fn to_engine(pose: &Pose) -> RapierPose {
    let q = pose.rotation();
    let rotation = Rotation::from_xyzw(q.i as f32, q.j as f32, q.k as f32, q.w as f32).normalize();
    RapierPose::from_parts(vector(&pose.translation()), rotation)
}

/// From the engine's pose.
pub(crate) fn from_engine(pose: &RapierPose) -> Pose {
    let q = pose.rotation;
    let rotation = Quaternion::new(f64::from(q.w), f64::from(q.x), f64::from(q.y), f64::from(q.z));
    Pose::new(UnitQuaternion::from_quaternion(rotation), vec3(&pose.translation))
}

/// A body's pose.
pub(crate) fn body_pose(world: &PhysicsWorld, body: RigidBodyHandle) -> Pose {
    world.bodies.get(body).map_or_else(Pose::identity, |b| from_engine(b.position()))
}

/// A body's velocity, m/s.
pub(crate) fn velocity(world: &PhysicsWorld, body: RigidBodyHandle) -> Vec3 {
    world.bodies.get(body).map_or_else(Vec3::zeros, |b| vec3(&b.linvel()))
}
