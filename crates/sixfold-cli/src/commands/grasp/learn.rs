//! `sixfold grasp learn`: a simulated hand tries grasps, and successful grasps become experience.

use anyhow::Result;
use sixfold_shell::Outcome;
use sixfold_shell::grasp::learn::{LearnArguments, Whole, learn, marks};
use sixfold_shell::output::report;

pub(super) fn run(a: &LearnArguments) -> Result<Outcome> {
    let whole = learn(a)?;
    report(&a.json, &whole, || print_table(&whole, a))?;
    Ok(if whole.held > 0 { Outcome::Found } else { Outcome::NothingFound })
}

fn print_table(whole: &Whole, a: &LearnArguments) {
    for c in &whole.objects {
        println!("{:>16} {}", c.object, marks(c));
    }
    println!("G geometry, E experience; capitals held");
    println!(
        "{} of {} held ({:.2}, 95 % interval {:.2} to {:.2}), {} from experience; {} experiences and {} outcomes in {}",
        whole.held,
        whole.attempts,
        whole.rate,
        whole.interval.0,
        whole.interval.1,
        whole.from_experience,
        whole.experiences,
        whole.outcomes,
        a.experiences.display()
    );
}
