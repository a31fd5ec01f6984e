//! The essential matrices of five pairs of rays: the constraints of Nistér (2004, "An efficient solution to the five-point relative
//! pose problem", equations 7-9), solved by an action matrix (Stewénius, Engels and Nistér 2006). Works for planar scenes too.

use sixfold_geometry::nalgebra::{Complex, SMatrix, SVector, Schur};
use sixfold_geometry::{Mat3, Vec2};

/// Exponents of x, y, z of the cubic monomials: those of degree 3 first; the last ten span the quotient ring.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [2, 1, 0],
    [1, 2, 0],
    [0, 3, 0],
    [2, 0, 1],
    [1, 1, 1],
    [0, 2, 1],
    [1, 0, 2],
    [0, 1, 2],
    [0, 0, 3],
    [2, 0, 0],
    [1, 1, 0],
    [0, 2, 0],
    [1, 0, 1],
    [0, 1, 1],
    [0, 0, 2],
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
    [0, 0, 0],
];
/// The product of x and each of the last ten monomials: a row of the reduced system, or another of the ten.
const TIMES_X: [usize; 10] = [0, 1, 2, 4, 5, 7, 10, 11, 13, 16];
/// An eigenvalue counts as real if its imaginary part is below this fraction. Chosen by hand; not swept.
const REAL: f64 = 1e-7;

/// A polynomial of degree up to 3 in x, y and z.
type Cubic = [f64; 20];

fn place(exponents: [u8; 3]) -> usize {
    MONOMIALS.iter().position(|m| *m == exponents).unwrap_or(19)
}

/// The indices of the products of two monomials; only for products of degree up to 3.
fn products() -> [[usize; 20]; 20] {
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let sum = std::array::from_fn(|k| MONOMIALS[i][k] + MONOMIALS[j][k]);
            if sum.iter().sum::<u8>() <= 3 { place(sum) } else { usize::MAX }
        })
    })
}

/// The table of products, made once.
static PRODUCTS: std::sync::LazyLock<[[usize; 20]; 20]> = std::sync::LazyLock::new(products);

fn times(a: &Cubic, b: &Cubic) -> Cubic {
    let mut out = [0.0; 20];
    for (i, a) in a.iter().enumerate().filter(|(_, a)| **a != 0.0) {
        for (j, b) in b.iter().enumerate().filter(|(_, b)| **b != 0.0) {
            if let Some(sum) = out.get_mut(PRODUCTS[i][j]) {
                *sum += a * b;
            }
        }
    }
    out
}

fn plus(a: &Cubic, b: &Cubic, factor: f64) -> Cubic {
    std::array::from_fn(|i| a[i] + factor * b[i])
}

/// All essential matrices `E` with `second' E first = 0` for five pairs of points on the plane `z = 1`, of norm 1.
pub fn essential_matrices(first: &[Vec2; 5], second: &[Vec2; 5]) -> Vec<Mat3> {
    let mut rows = SMatrix::<f64, 9, 9>::zeros();
    for (i, (a, b)) in first.iter().zip(second).enumerate() {
        let (a, b) = (a.push(1.0), b.push(1.0));
        (0..9).for_each(|k| rows[(i, k)] = b[k / 3] * a[k % 3]);
    }
    let svd = rows.svd(false, true);
    let Some(v) = svd.v_t else { return vec![] };
    let mut order: [usize; 9] = std::array::from_fn(|i| i);
    order.sort_by(|a, b| svd.singular_values[*a].total_cmp(&svd.singular_values[*b]));
    let basis: [Mat3; 4] = std::array::from_fn(|k| Mat3::from_fn(|i, j| v[(order[k], 3 * i + j)]));
    let Some(reduced) = reduced_system(&basis) else { return vec![] };
    let mut action = SMatrix::<f64, 10, 10>::zeros();
    for (row, of) in TIMES_X.into_iter().enumerate() {
        if of < 10 {
            (0..10).for_each(|k| action[(row, k)] = -reduced[(of, k)]);
        } else {
            action[(row, of - 10)] = 1.0;
        }
    }
    let Some(schur) = Schur::try_new(action, 1e-14, 400) else { return vec![] };
    let values = schur.complex_eigenvalues();
    let of = |value: &Complex<f64>| {
        let real = value.im.abs() <= REAL * (1.0 + value.re.abs());
        let vector = real.then(|| eigenvector(&action, value.re)).flatten()?;
        let [x, y, z, one] = [vector[6], vector[7], vector[8], vector[9]];
        let e = basis[0] * x + basis[1] * y + basis[2] * z + basis[3] * one;
        let norm = e.norm();
        (norm.is_finite() && norm > 0.0).then(|| e / norm)
    };
    values.iter().filter_map(of).collect()
}

/// The ten constraints after elimination of the monomials of degree 3: each of these, negated, in terms of the last ten.
fn reduced_system(basis: &[Mat3; 4]) -> Option<SMatrix<f64, 10, 10>> {
    let linear = |i: usize, j: usize| {
        let mut p = [0.0; 20];
        (0..4).for_each(|k| p[16 + k] = basis[k][(i, j)]);
        p
    };
    let e: [[Cubic; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| linear(i, j)));
    // E E', its trace, and 2 E E' E - trace(E E') E.
    let zero = [0.0; 20];
    let square: [[Cubic; 3]; 3] = std::array::from_fn(|i| {
        std::array::from_fn(|j| (0..3).fold(zero, |sum, k| plus(&sum, &times(&e[i][k], &e[j][k]), 1.0)))
    });
    let trace = (0..3).fold(zero, |sum, i| plus(&sum, &square[i][i], 1.0));
    let mut system = SMatrix::<f64, 10, 20>::zeros();
    let mut put = |row: usize, p: &Cubic| (0..20).for_each(|k| system[(row, k)] = p[k]);
    for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
        let product = (0..3).fold(zero, |sum, k| plus(&sum, &times(&square[i][k], &e[k][j]), 2.0));
        put(3 * i + j, &plus(&product, &times(&trace, &e[i][j]), -1.0));
    }
    let minor = |a: usize, b: usize| plus(&times(&e[1][a], &e[2][b]), &times(&e[1][b], &e[2][a]), -1.0);
    let determinant = [(0, minor(1, 2)), (1, minor(2, 0)), (2, minor(0, 1))]
        .iter()
        .fold(zero, |sum, (k, m)| plus(&sum, &times(&e[0][*k], m), 1.0));
    put(9, &determinant);
    let left: SMatrix<f64, 10, 10> = system.fixed_view::<10, 10>(0, 0).into_owned();
    let right: SMatrix<f64, 10, 10> = system.fixed_view::<10, 10>(0, 10).into_owned();
    let reduced = left.full_piv_lu().solve(&right)?;
    reduced.iter().all(|v| v.is_finite()).then_some(reduced)
}

/// The eigenvector of an eigenvalue, by inverse iteration.
fn eigenvector(matrix: &SMatrix<f64, 10, 10>, value: f64) -> Option<SVector<f64, 10>> {
    let shifted = matrix - SMatrix::<f64, 10, 10>::identity() * (value + 1e-11 * (1.0 + value.abs()));
    let lu = shifted.lu();
    let mut vector = SVector::<f64, 10>::from_fn(|i, _| 1.0 + 0.1 * i as f64);
    for _ in 0..3 {
        vector = lu.solve(&vector)?.try_normalize(0.0)?;
    }
    vector.iter().all(|v| v.is_finite()).then_some(vector)
}

#[cfg(test)]
mod tests {
    use super::*;
    use sixfold_geometry::{Pose, Vec3};

    fn skew(t: &Vec3) -> Mat3 {
        Mat3::new(0.0, -t.z, t.y, t.z, 0.0, -t.x, -t.y, t.x, 0.0)
    }

    #[test]
    fn the_truth_is_among_the_solutions_also_of_a_plane() {
        for flat in [false, true] {
            for k in 0..50 {
                let t = f64::from(k);
                let motion = Pose::exp(&[0.3, 0.1 * t.sin(), 0.1, 0.2 * t.cos(), -0.3, 0.1].into());
                let point = |i: usize| {
                    let s = 1.7 * i as f64 + t;
                    let depth = if flat { 0.0 } else { 0.5 * (2.3 * s).sin() };
                    Vec3::new(s.sin(), (1.3 * s).cos(), 3.0 + 0.3 * s.sin() + depth)
                };
                let first = std::array::from_fn(|i| (point(i) / point(i).z).xy());
                let second = std::array::from_fn(|i| {
                    let p = motion.transform_point(&point(i));
                    (p / p.z).xy()
                });
                let truth = skew(&motion.translation()) * motion.rotation_matrix();
                let truth = truth / truth.norm();
                let found = essential_matrices(&first, &second);
                let best = found
                    .iter()
                    .map(|e| (e - truth).norm().min((e + truth).norm()))
                    .fold(f64::INFINITY, f64::min);
                assert!(best < 1e-6, "{best:e} of {} solutions, {k}", found.len());
            }
        }
    }

    #[test]
    fn equal_points_give_nothing_that_is_not_finite() {
        let same = [Vec2::new(0.1, 0.2); 5];
        assert!(essential_matrices(&same, &same).iter().all(|e| e.iter().all(|v| v.is_finite())));
    }
}
