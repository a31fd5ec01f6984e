//! The trial of one grasp: approach, close, lift by 10 cm, shake; then test whether the object is held.
//!
//! The fingers slide on the palm, each driven by a motor with a limited force, and are coupled like the two jaws of a real gripper:
//! a force on one moves the other. The palm follows its path regardless of contacts. The speed ramps up and down, so that no jerk
//! adds to the weight.

use rapier3d::prelude::*;
use serde::Serialize;
use sixfold_geometry::{Pose, Vec3};
use sixfold_grasp::Gripper;

use crate::error::check_ranges;
use crate::parts::vector;
use crate::world::{GRIPPER, body_pose, insert_object, to_engine, velocity, world};
use crate::{ConvexParts, SimulationError};

/// How a grasp is tried.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TrialOptions {
    /// The object's mass, kg.
    pub mass: f64,
    /// Coulomb friction coefficient of the table.
    pub table_friction: f64,
    /// Distance from the grasp at which the approach begins, metres.
    pub stand_off: f64,
    /// How far the object is lifted, metres.
    pub lift: f64,
    /// Speed of approach and lift, m/s.
    pub speed: f64,
    /// Amplitude of the shake, vertical and then to the side, metres.
    pub shake: f64,
    /// Frequency of the shake, hertz.
    pub shake_frequency: f64,
    /// Time step, seconds.
    pub time_step: f64,
    /// Stiffness of contacts: natural frequency, hertz.
    pub contact_frequency: f64,
}

impl Default for TrialOptions {
    fn default() -> Self {
        TrialOptions {
            mass: 0.2,
            table_friction: 0.5,
            stand_off: 0.1,
            lift: 0.1,
            speed: 0.25,
            shake: 0.02,
            shake_frequency: 2.0,
            time_step: 0.001,
            contact_frequency: 240.0,
        }
    }
}

impl TrialOptions {
    /// Tests every field.
    ///
    /// # Errors
    /// [`SimulationError::Option`].
    pub fn check(&self) -> Result<(), SimulationError> {
        check_ranges(&[
            ("mass", self.mass, 0.001, 20.0, "0.001 to 20 kg"),
            ("table_friction", self.table_friction, 0.0, 2.0, "0 to 2"),
            ("stand_off", self.stand_off, 0.0, 1.0, "0 to 1 m"),
            ("lift", self.lift, 0.01, 1.0, "0.01 to 1 m"),
            ("speed", self.speed, 0.01, 2.0, "0.01 to 2 m/s"),
            ("shake", self.shake, 0.0, 0.2, "0 to 0.2 m"),
            ("shake_frequency", self.shake_frequency, 0.0, 20.0, "0 to 20 Hz"),
            ("time_step", self.time_step, 1e-4, 0.005, "0.0001 to 0.005 s"),
            ("contact_frequency", self.contact_frequency, 10.0, 1000.0, "10 to 1000 Hz"),
        ])
    }
}

/// How a trial ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// After lift and shake the object is off the table, between both fingers.
    Held,
    /// Before any motion, the gripper overlaps the table at the grasp pose, or the object at the stand-off.
    Blocked,
    /// The fingers closed without the object.
    Missed,
    /// The object was between the fingers and lost in the lift.
    LostInLift,
    /// The object was lifted and lost in the shake.
    LostInShake,
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Outcome::Held => "held",
            Outcome::Blocked => "the gripper cannot get there",
            Outcome::Missed => "the fingers closed on nothing",
            Outcome::LostInLift => "lost in the lift",
            Outcome::LostInShake => "lost in the shake",
        })
    }
}

/// What happened in a trial.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TrialReport {
    /// How it ended.
    pub outcome: Outcome,
    /// Distance of the pads at the end, metres.
    pub gap: f64,
    /// How much the object's own origin rose, metres.
    pub raised: f64,
    /// How far the object slid between the fingers from the end of closing to the end of the trial, metres.
    pub slip: f64,
    /// Angle by which it rotated between the fingers in that time, radians.
    pub turn: f64,
    /// How far the object was moved before the lift, metres.
    pub pushed: f64,
    /// Simulated time, seconds.
    pub time: f64,
}

/// Mass of a finger, kg. With lighter ones the contact solver is unstable.
const FINGER_MASS: f64 = 0.3;
/// Speed at which a free finger closes, m/s.
const CLOSING_SPEED: f64 = 0.1;
/// Extra time for closing, seconds, so that the contact settles.
const SQUEEZE: f64 = 0.3;
/// Stiffness of the coupling of the two fingers, N/m.
const COUPLING: f64 = 2e4;

/// Tries a grasp on an object on the table. `world_from_gripper` is the gripper's pose when it closes (its frame is defined in the
/// crate documentation of `sixfold-grasp`), `opening` the distance of its pads before that, metres.
///
/// # Errors
/// [`SimulationError::Option`] for options out of range, or an opening that the gripper cannot reach.
pub fn try_grasp(
    parts: &ConvexParts,
    world_from_object: &Pose,
    gripper: &Gripper,
    world_from_gripper: &Pose,
    opening: f64,
    options: &TrialOptions,
) -> Result<TrialReport, SimulationError> {
    options.check()?;
    if !(opening > 0.0 && opening <= gripper.max_opening + 1e-9) {
        return Err(SimulationError::Option {
            field: "opening",
            found: opening,
            expected: "above 0 and at most the gripper's max_opening",
        });
    }
    let mut run = Run::new(parts, world_from_object, gripper, world_from_gripper, opening, options);
    if run.blocked(gripper, world_from_gripper, opening) {
        return Ok(run.report(Outcome::Blocked));
    }
    // Approach.
    let approach = world_from_gripper.transform_direction(&Vec3::z());
    run.travel(approach * options.stand_off, options.speed);
    // Close.
    run.closing = true;
    let way = 0.5 * opening / CLOSING_SPEED + SQUEEZE;
    run.wait(way);
    run.pushed = (run.object().translation() - run.start.translation()).norm();
    run.held_at = run.palm().inverse() * run.object();
    if run.gap() < MIN_GAP || !run.touches() {
        return Ok(run.report(Outcome::Missed));
    }
    // Lift.
    run.travel(Vec3::z() * options.lift, options.speed);
    run.wait(0.2);
    if !run.holds() {
        return Ok(run.report(Outcome::LostInLift));
    }
    // Shake, one second up and down and one second to the side, along the horizontal part of the closing direction.
    let side = world_from_gripper.transform_direction(&Vec3::x());
    let side = (side - Vec3::z() * side.z).try_normalize(0.1).unwrap_or_else(Vec3::x);
    for direction in [Vec3::z(), side] {
        run.shake(direction * options.shake, options.shake_frequency, 1.0);
    }
    run.wait(0.2);
    let outcome = if run.holds() { Outcome::Held } else { Outcome::LostInShake };
    Ok(run.report(outcome))
}

/// If the gap between the pads is smaller than this, they hold nothing, metres.
const MIN_GAP: f64 = 0.0005;

struct Run {
    world: PhysicsWorld,
    object: RigidBodyHandle,
    object_collider: ColliderHandle,
    palm: RigidBodyHandle,
    palm_at: Pose,
    fingers: [Finger; 2],
    opening: f64,
    force: f64,
    closing: bool,
    start: Pose,
    held_at: Pose,
    pushed: f64,
    lift: f64,
    steps: usize,
}

struct Finger {
    body: RigidBodyHandle,
    collider: ColliderHandle,
    joint: ImpulseJointHandle,
    /// Its position in the palm's frame when open.
    open_at: Vec3,
    /// The direction in which it closes, in the palm's frame.
    inwards: Vec3,
}

impl Run {
    fn new(
        parts: &ConvexParts,
        world_from_object: &Pose,
        gripper: &Gripper,
        world_from_gripper: &Pose,
        opening: f64,
        options: &TrialOptions,
    ) -> Run {
        let mut world = world(options.time_step, options.contact_frequency, options.table_friction);
        let (object, object_collider) =
            insert_object(&mut world, parts, world_from_object, options.mass, 0.0);
        let approach = world_from_gripper.transform_direction(&Vec3::z());
        let palm_at = world_from_gripper
            .with_translation(world_from_gripper.translation() - approach * options.stand_off);
        let boxes = gripper.boxes(opening);
        let pads = |builder: ColliderBuilder| {
            builder
                .friction(gripper.friction as f32)
                .friction_combine_rule(CoefficientCombineRule::Multiply)
                .collision_groups(GRIPPER)
        };
        let cuboid = |part: &sixfold_grasp::GripperBox| {
            let half = part.half_size();
            pads(ColliderBuilder::cuboid(half.x as f32, half.y as f32, half.z as f32))
        };
        let (palm, _) = world.insert(
            RigidBodyBuilder::kinematic_position_based().pose(to_engine(&palm_at)),
            cuboid(&boxes[2]).translation(vector(&boxes[2].centre())),
        );
        let fingers = std::array::from_fn(|i| {
            let open_at = boxes[i].centre();
            let inwards = if i == 0 { Vec3::x() } else { -Vec3::x() };
            let at = palm_at * Pose::from_translation(open_at);
            let (body, collider) = world.insert(
                RigidBodyBuilder::dynamic().pose(to_engine(&at)).gravity_scale(0.0).can_sleep(false),
                cuboid(&boxes[i]).mass(FINGER_MASS as f32),
            );
            let joint = PrismaticJointBuilder::new(vector(&inwards))
                .local_anchor1(vector(&open_at))
                .local_anchor2(Vector::ZERO)
                .motor_model(MotorModel::ForceBased)
                .motor_position(0.0, 1e4, 1e2)
                .motor_max_force(gripper.force as f32)
                .limits([-0.5 * (gripper.max_opening - opening) as f32, 0.5 * opening as f32]);
            let joint = world.insert_impulse_joint(palm, body, joint.build());
            Finger { body, collider, joint, open_at, inwards }
        });
        let mut run = Run {
            world,
            object,
            object_collider,
            palm,
            palm_at,
            fingers,
            opening,
            force: gripper.force,
            closing: false,
            start: *world_from_object,
            held_at: Pose::identity(),
            pushed: 0.0,
            lift: options.lift,
            steps: 0,
        };
        run.held_at = run.palm().inverse() * run.object();
        run
    }

    fn dt(&self) -> f64 {
        f64::from(self.world.integration_parameters.dt)
    }

    fn object(&self) -> Pose {
        body_pose(&self.world, self.object)
    }

    fn palm(&self) -> Pose {
        body_pose(&self.world, self.palm)
    }

    /// How far a finger has closed, metres, and its speed, m/s.
    fn travelled(&self, finger: &Finger) -> (f64, f64) {
        let palm = self.palm();
        let at = palm.inverse().transform_point(&body_pose(&self.world, finger.body).translation());
        let inwards = palm.transform_direction(&finger.inwards);
        let speed = velocity(&self.world, finger.body) - velocity(&self.world, self.palm);
        ((at - finger.open_at).dot(&finger.inwards), speed.dot(&inwards))
    }

    fn gap(&self) -> f64 {
        self.opening - self.fingers.iter().map(|f| self.travelled(f).0).sum::<f64>()
    }

    /// Whether the object touches both fingers.
    fn touches(&self) -> bool {
        self.fingers.iter().all(|finger| {
            self.world
                .narrow_phase
                .contact_pair(self.object_collider, finger.collider)
                .is_some_and(|pair| pair.has_any_active_contact())
        })
    }

    /// Whether the object is off the table and between both fingers.
    fn holds(&self) -> bool {
        let raised = self.object().translation().z - self.start.translation().z;
        self.gap() > MIN_GAP && self.touches() && raised > 0.5 * self.lift
    }

    /// Whether the trial cannot begin: a part of the gripper is below the table at the grasp pose, or inside the object at the
    /// stand-off.
    fn blocked(&self, gripper: &Gripper, world_from_gripper: &Pose, opening: f64) -> bool {
        let boxes = gripper.boxes(opening);
        if boxes
            .iter()
            .any(|part| part.corners().iter().any(|c| world_from_gripper.transform_point(c).z < 0.0))
        {
            return true;
        }
        let Some(object) = self.world.colliders.get(self.object_collider) else { return true };
        boxes.iter().any(|part| {
            let half = part.half_size();
            let shape = SharedShape::cuboid(half.x as f32, half.y as f32, half.z as f32);
            let at = to_engine(&(self.palm_at * Pose::from_translation(part.centre())));
            rapier3d::parry::query::intersection_test(&at, &*shape, object.position(), object.shape())
                .map_or(true, |hit| hit.intersecting)
        })
    }

    /// One time step with the palm at a pose.
    fn step_to(&mut self, palm_at: Pose) {
        self.palm_at = palm_at;
        if let Some(palm) = self.world.bodies.get_mut(self.palm) {
            palm.set_next_kinematic_position(to_engine(&palm_at));
        }
        // The jaws are coupled: a spring, stiff compared with their load, keeps them closed by equal amounts.
        let [(left, left_speed), (right, right_speed)] =
            [self.travelled(&self.fingers[0]), self.travelled(&self.fingers[1])];
        let damping = 2.0 * (COUPLING * 0.5 * FINGER_MASS).sqrt();
        let pull = COUPLING * (left - right) + damping * (left_speed - right_speed);
        for (finger, pull) in self.fingers.iter().zip([-pull, pull]) {
            let along = palm_at.transform_direction(&finger.inwards) * pull;
            if let Some(body) = self.world.bodies.get_mut(finger.body) {
                body.reset_forces(true);
                body.add_force(vector(&along), true);
            }
            if self.closing
                && let Some(joint) = self.world.impulse_joints.get_mut(finger.joint, true)
            {
                joint.data.set_motor(JointAxis::LinX, 0.0, CLOSING_SPEED as f32, 0.0, 1e3);
                joint.data.set_motor_max_force(JointAxis::LinX, self.force as f32);
            }
        }
        self.world.step();
        self.steps += 1;
    }

    fn wait(&mut self, seconds: f64) {
        for _ in 0..(seconds / self.dt()).ceil() as usize {
            self.step_to(self.palm_at);
        }
    }

    /// Moves the palm by `way`, speeding up and slowing down smoothly.
    fn travel(&mut self, way: Vec3, speed: f64) {
        let length = way.norm();
        if length < 1e-9 {
            return;
        }
        // A cubic smoothstep: its maximum speed is 1.5 times the mean.
        let seconds = 1.5 * length / speed;
        let steps = (seconds / self.dt()).ceil().max(1.0) as usize;
        let start = self.palm_at;
        for k in 1..=steps {
            let s = k as f64 / steps as f64;
            let fraction = s * s * (3.0 - 2.0 * s);
            self.step_to(start.with_translation(start.translation() + way * fraction));
        }
    }

    /// Oscillates the palm around its position, with an amplitude that rises and falls smoothly.
    fn shake(&mut self, amplitude: Vec3, frequency: f64, seconds: f64) {
        let steps = (seconds / self.dt()).ceil() as usize;
        let start = self.palm_at;
        for k in 1..=steps {
            let t = k as f64 / steps as f64;
            let envelope = (8.0 * t).min(8.0 * (1.0 - t)).min(1.0);
            let swing = envelope * (std::f64::consts::TAU * frequency * seconds * t).sin();
            self.step_to(start.with_translation(start.translation() + amplitude * swing));
        }
    }

    fn report(&self, outcome: Outcome) -> TrialReport {
        let now = self.palm().inverse() * self.object();
        TrialReport {
            outcome,
            gap: self.gap(),
            raised: self.object().translation().z - self.start.translation().z,
            slip: now.distance_to(&self.held_at),
            turn: now.rotation_angle_to(&self.held_at),
            pushed: self.pushed,
            time: self.steps as f64 * self.dt(),
        }
    }
}
