//! Outcomes of earlier attempts: predicts the probability that the next grasp holds.
//!
//! The dissertation stores successes only ("unsuccessful grasp attempts do not provide any information for replicating past
//! experience", section 6.2.1), and ranks by the distance of an experience. Failures are informative too: they show how much worse
//! than the planner assumes a grasp is at the edge of its friction cone, or far from the object's centre, with this gripper and
//! these pads. So every attempt is stored with what was known before it, and a logistic regression on 16 numbers from that, with a
//! normal prior (Cox 1958; MAP by Newton's method), predicts the next one. The prior was fitted to simulated attempts: without
//! attempts of its own, a gripper ranks grasps by the quality of the contacts and the agreement with experience, as in section
//! 6.3.2, and keeps a distance from the table.

use sixfold_experience::Attempt;
use sixfold_geometry::nalgebra::{SMatrix, SVector};
use sixfold_grasp::GraspDescription;

/// Number of inputs that describe a grasp to the model, including the constant.
const NUMBERS: usize = 17;
type Numbers = SVector<f64, NUMBERS>;

/// Weights without any attempt, in the order of [`numbers`]: fitted to 1322 simulated attempts at synthetic objects by a gripper
/// with an error of 5 mm and 3 degrees (`sixfold grasp learn --families all --members 5 --tries 2 --explore 8 --near 0 --hard`,
/// then [`OutcomeModel::learn`]), rounded. Those attempts had no experience, so its weight was chosen by us.
const PRIOR: [f64; NUMBERS] =
    [0.15, 0.1, -0.2, 0.25, 0.25, 0.55, 0.2, -0.1, 0.75, 0.35, 0.4, 1.0, 0.0, 0.0, -0.6, 0.9, 0.65];
/// Inverse variance of the weights around the prior. The constant is almost unconstrained.
const PRECISION: f64 = 5.0;
const PRECISION_OF_CONSTANT: f64 = 0.01;

/// Clearance from the table enters by its logarithm between these limits, metres: the first millimetres matter most.
const ROOM: (f64, f64) = (0.003, 0.1);
/// Below this it enters a second time, linearly, metres: a gripper with an error of millimetres may touch the table.
const SCARCE: f64 = 0.01;
/// Distance of the object's centre along the closing direction, metres, from which a part at the object's side may be held, and
/// from which it certainly is.
const WALL: (f64, f64) = (0.015, 0.035);

/// The inputs for a grasp, each in about -1 to 1.
fn numbers(d: &GraspDescription, agreement: f64, transferred: bool) -> Numbers {
    let q = &d.quality;
    let both_sides = |v: f64| 2.0 * v - 1.0;
    let room = d.table_room.unwrap_or(ROOM.1);
    let overlap = both_sides(d.overlap.clamp(0.0, 0.05) / 0.05);
    // Holding a wall or a handle at the object's side differs from holding the object near its centre.
    let wall = ((d.lever - WALL.0) / (WALL.1 - WALL.0)).clamp(0.0, 1.0);
    Numbers::from([
        1.0,
        both_sides(q.alignment),
        both_sides(q.support),
        both_sides(q.centring),
        both_sides(q.observed),
        overlap,
        -both_sides(d.lever.clamp(0.0, 0.06) / 0.06),
        d.above_middle.clamp(-0.03, 0.03) / 0.03,
        (room.clamp(ROOM.0, ROOM.1) / 0.02).ln() / 5f64.ln(),
        both_sides(room.clamp(0.0, SCARCE) / SCARCE),
        2.0 * q.total().max(0.03).ln() + 2.0,
        agreement,
        f64::from(u8::from(transferred)),
        wall,
        wall * both_sides(q.alignment),
        wall * overlap,
        // The torque of the weight relative to that which the pads can hold.
        1.0 - 0.5 * (d.lever / d.overlap.max(0.002)).min(4.0),
    ])
}

/// The probability that a grasp holds, from the attempts so far.
#[derive(Debug, Clone, PartialEq)]
pub struct OutcomeModel {
    weights: Numbers,
    /// Number of attempts it was fitted to.
    pub attempts: usize,
    /// How many of them held.
    pub held: usize,
}

impl Default for OutcomeModel {
    fn default() -> Self {
        OutcomeModel { weights: Numbers::from(PRIOR), attempts: 0, held: 0 }
    }
}

impl OutcomeModel {
    /// Learns from the attempts with a gripper. The same attempts in the same order give the same model.
    pub fn learn<'a>(attempts: impl IntoIterator<Item = &'a Attempt>, gripper: &str) -> OutcomeModel {
        let seen: Vec<(Numbers, f64)> = attempts
            .into_iter()
            .filter(|a| a.gripper == gripper && a.check().is_ok())
            .map(|a| (numbers(&a.description, a.agreement, a.transferred), f64::from(u8::from(a.held))))
            .collect();
        let mut model = OutcomeModel {
            attempts: seen.len(),
            held: seen.iter().filter(|(_, held)| *held > 0.5).count(),
            ..OutcomeModel::default()
        };
        let prior = model.weights;
        let mut precision = SMatrix::<f64, NUMBERS, NUMBERS>::identity() * PRECISION;
        precision[(0, 0)] = PRECISION_OF_CONSTANT;
        let loss = |w: &Numbers| -> f64 {
            let fit: f64 = seen
                .iter()
                .map(|(x, held)| {
                    let z = if *held > 0.5 { -w.dot(x) } else { w.dot(x) };
                    z.max(0.0) + (-z.abs()).exp().ln_1p()
                })
                .sum();
            let off = w - prior;
            fit + 0.5 * off.dot(&(precision * off))
        };
        let mut value = loss(&model.weights);
        for _ in 0..50 {
            let mut gradient = precision * (model.weights - prior);
            let mut curvature = precision;
            for (x, held) in &seen {
                let p = sigmoid(model.weights.dot(x));
                gradient += x * (p - held);
                curvature += x * x.transpose() * (p * (1.0 - p));
            }
            let Some(step) = curvature.cholesky().map(|c| c.solve(&gradient)) else { break };
            // Newton's step may be too long where the sigmoid is flat.
            let mut length = 1.0;
            let mut next = model.weights - step;
            while loss(&next) > value && length > 1e-6 {
                length *= 0.5;
                next = model.weights - step * length;
            }
            let reached = loss(&next);
            if !(reached < value) {
                break;
            }
            let gained = value - reached;
            (model.weights, value) = (next, reached);
            if gained < 1e-9 {
                break;
            }
        }
        model
    }

    /// The probability that a grasp holds, 0 to 1.
    pub(crate) fn success_probability(
        &self,
        description: &GraspDescription,
        agreement: f64,
        transferred: bool,
    ) -> f64 {
        sigmoid(self.weights.dot(&numbers(description, agreement, transferred)))
    }
}

fn sigmoid(z: f64) -> f64 {
    1.0 / (1.0 + (-z).exp())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use sixfold_grasp::AntipodalQuality;

    fn description(alignment: f64, lever: f64) -> GraspDescription {
        let quality = AntipodalQuality { alignment, support: 0.8, centring: 0.7, observed: 0.5 };
        GraspDescription { quality, overlap: 0.03, lever, above_middle: 0.0, table_room: Some(0.02) }
    }

    fn attempt(description: GraspDescription, held: bool) -> Attempt {
        let (gripper, object) = ("jaws".to_owned(), "can".to_owned());
        let provenance = "test".to_owned();
        Attempt {
            description,
            agreement: 0.0,
            transferred: false,
            held,
            gripper,
            object,
            time: 0,
            provenance,
        }
    }

    #[test]
    fn without_attempts_quality_agreement_and_room_decide() {
        let model = OutcomeModel::learn(&[], "jaws");
        let of =
            |alignment, agreement| model.success_probability(&description(alignment, 0.0), agreement, false);
        assert!(of(0.9, 0.0) > of(0.5, 0.0));
        assert!(of(0.5, 0.9) > of(0.5, 0.1));
        // The prior from simulated attempts: a lever is worse than none, and so is a table close to the fingers.
        assert!(model.success_probability(&description(0.5, 0.05), 0.0, false) < of(0.5, 0.0));
        let above = |room: f64| {
            let d = GraspDescription { table_room: Some(room), ..description(0.5, 0.0) };
            model.success_probability(&d, 0.0, false)
        };
        assert!(above(0.004) + 0.15 < above(0.012), "{} {}", above(0.004), above(0.012));
        assert!(
            above(0.03) - above(0.012) < above(0.012) - above(0.004),
            "the first millimetres are worth most"
        );
    }

    #[test]
    fn it_learns_failures_of_this_gripper_only() {
        // A gripper that loses objects held away from their centre, whatever the contacts: 3 of 4 times against 1 of 10.
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let attempts: Vec<Attempt> = (0..200)
            .map(|_| {
                let (alignment, off) = (random.random_range(0.2..1.0), random.random_bool(0.5));
                let lost = random.random_bool(if off { 0.75 } else { 0.1 });
                attempt(description(alignment, if off { 0.05 } else { 0.005 }), !lost)
            })
            .collect();
        let model = OutcomeModel::learn(&attempts, "jaws");
        let off = model.success_probability(&description(0.95, 0.05), 0.0, false);
        let near = model.success_probability(&description(0.5, 0.005), 0.0, false);
        assert!(off < 0.45 && near > 0.8, "{off} {near}");
        assert_eq!(model.attempts, 200);
        assert_eq!(OutcomeModel::learn(&attempts, "other"), OutcomeModel::default());
        // Successes alone do not make everything certain.
        let good: Vec<Attempt> = (0..50).map(|_| attempt(description(0.7, 0.0), true)).collect();
        let sure = OutcomeModel::learn(&good, "jaws").success_probability(&description(0.7, 0.0), 0.0, false);
        assert!(sure > 0.9 && sure < 0.9999, "{sure}");
    }

    #[test]
    fn walls_and_centres_are_learned_separately() {
        // At a wall the pads must reach far, at the centre they must not: a sum of both inputs cannot express this.
        let of = |wall: bool, deep: bool| GraspDescription {
            lever: if wall { 0.045 } else { 0.0 },
            overlap: if deep { 0.045 } else { 0.01 },
            ..description(0.5, 0.0)
        };
        let four = [(false, false), (false, true), (true, false), (true, true)];
        let attempts: Vec<Attempt> =
            (0..120).map(|k| four[k % 4]).map(|(wall, deep)| attempt(of(wall, deep), wall == deep)).collect();
        let model = OutcomeModel::learn(&attempts, "jaws");
        for (wall, deep) in four {
            let success_probability = model.success_probability(&of(wall, deep), 0.0, false);
            assert_eq!(success_probability > 0.5, wall == deep, "{wall} {deep} {success_probability}");
        }
    }

    #[test]
    fn it_is_where_the_loss_is_smallest() {
        // The gradient of the penalised loss, computed directly, is zero there.
        let attempts: Vec<Attempt> = (0..60)
            .map(|k| {
                let d = description(f64::from(k % 10) / 10.0, f64::from(k % 7) / 100.0);
                attempt(d, k % 3 != 0).rounded()
            })
            .collect();
        let model = OutcomeModel::learn(&attempts, "jaws");
        let mut gradient = (model.weights - Numbers::from(PRIOR)) * PRECISION;
        gradient[0] *= PRECISION_OF_CONSTANT / PRECISION;
        for a in &attempts {
            let x = numbers(&a.description, a.agreement, a.transferred);
            gradient += x * (sigmoid(model.weights.dot(&x)) - f64::from(u8::from(a.held)));
        }
        assert!(gradient.amax() < 1e-4, "{gradient}");
    }
}
