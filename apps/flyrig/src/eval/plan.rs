//! Cameras that are held out, and what an evaluation of so many cameras can say.

/// Number of cameras from which each is held out in turn.
const LEAST_IN_TURN: usize = 4;
/// Largest number of cameras that are held out in turn without being named; each costs another reconstruction.
const MOST_IN_TURN: usize = 8;

/// Cameras of one reconstruction.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Split {
    /// Input cameras.
    pub inputs: Vec<String>,
    /// Cameras that are compared with the result and take no part in it.
    pub holdout: Vec<String>,
}

/// Reconstructions of an evaluation.
#[derive(Debug, PartialEq, Eq)]
pub struct EvalPlan {
    /// The first one is shown in film, page and input views.
    pub splits: Vec<Split>,
    /// How the cameras are evaluated, and what that means.
    pub method: String,
}

impl EvalPlan {
    /// Plans the evaluation of these input cameras, with cameras that are held out by name.
    pub fn new(inputs: &[String], holdout: &[String]) -> Self {
        let inputs = inputs.to_vec();
        let all = Split { inputs: inputs.clone(), holdout: holdout.to_vec() };
        if !holdout.is_empty() {
            let method = format!(
                "Held out: {}. Its images took no part in pose, masks, shape and colours; they are compared with what {} predict.",
                holdout.join(", "),
                inputs.join(", ")
            );
            return Self { splits: vec![all], method };
        }
        if inputs.len() < LEAST_IN_TURN {
            return Self { splits: vec![all], method: without_numbers(inputs.len()).to_owned() };
        }
        let tried = evenly(inputs.len(), MOST_IN_TURN);
        let chosen: Vec<&str> = tried.iter().map(|&at| inputs[at].as_str()).collect();
        let which = if chosen.len() == inputs.len() {
            "Each camera was held out in turn".to_owned()
        } else {
            format!("{} of {} cameras were held out in turn ({})", chosen.len(), inputs.len(), chosen.join(", "))
        };
        let method = format!(
            "{which}: its images took no part in pose, masks, shape and colours of that reconstruction, and are compared with what the \
             others predict. Film, page and input views show the reconstruction from all cameras, which is better than any of these."
        );
        let without = |&at: &usize| {
            let (held, rest) = (inputs[at].clone(), inputs.iter().enumerate().filter(|(i, _)| *i != at));
            Split { inputs: rest.map(|(_, name)| name.clone()).collect(), holdout: vec![held] }
        };
        let splits = std::iter::once(all).chain(tried.iter().map(without)).collect();
        Self { splits, method }
    }

    /// Returns the cameras that are held out, in the order of the splits.
    pub fn held_out(&self) -> Vec<String> {
        self.splits.iter().flat_map(|split| split.holdout.iter().cloned()).collect()
    }
}

/// Explains why fewer than four cameras give no number.
fn without_numbers(cameras: usize) -> &'static str {
    match cameras {
        1 => {
            "One camera: no number for new views can be given. The person is placed by the height of body and floor (--height, --floor), and \
             the sides that the camera does not see are guessed. A second camera gives depth; four give a score."
        }
        2 => {
            "Two cameras: no number for new views can be given, because a camera that is held out leaves one, which has no depth. Sides that \
             neither sees are guessed. Look at the input views and walk around the person; four cameras give a score."
        }
        _ => {
            "Three cameras: no number for new views can be given, because a camera that is held out leaves two, a poorer rig than yours. Look \
             at the input views and walk around the person; a fourth camera gives a score."
        }
    }
}

/// Returns `most` of `count` places, spread evenly; all of them if there are fewer.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    let chosen = count.min(most);
    (0..chosen).map(|i| i * count / chosen).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(count: usize) -> Vec<String> {
        (1..=count).map(|i| format!("{i:02}")).collect()
    }

    #[test]
    fn four_cameras_are_held_out_in_turn_and_never_see_themselves() {
        let plan = EvalPlan::new(&names(4), &[]);
        assert_eq!(plan.splits.len(), 5);
        assert_eq!((plan.splits[0].inputs.len(), plan.splits[0].holdout.len()), (4, 0));
        assert_eq!(plan.held_out(), names(4));
        for split in &plan.splits[1..] {
            assert_eq!((split.inputs.len(), split.holdout.len()), (3, 1));
            assert!(!split.inputs.contains(&split.holdout[0]));
        }
        assert!(plan.method.starts_with("Each camera was held out in turn"), "{}", plan.method);
    }

    #[test]
    fn fewer_cameras_say_what_is_possible_and_many_are_sampled() {
        for (count, word) in [(1, "One camera"), (2, "Two cameras"), (3, "Three cameras")] {
            let plan = EvalPlan::new(&names(count), &[]);
            assert_eq!(plan.splits.len(), 1);
            assert!(plan.method.starts_with(word) && plan.method.contains("no number"), "{}", plan.method);
        }
        let plan = EvalPlan::new(&names(23), &[]);
        assert_eq!(plan.splits.len(), 1 + MOST_IN_TURN);
        assert!(plan.method.starts_with("8 of 23 cameras were held out in turn (01, 03,"), "{}", plan.method);
        assert_eq!(evenly(9, 8), [0, 1, 2, 3, 4, 5, 6, 7]);
    }

    #[test]
    fn named_cameras_are_held_out_together() {
        let plan = EvalPlan::new(&names(2), &["07".to_owned(), "08".to_owned()]);
        assert_eq!(plan.splits, [Split { inputs: names(2), holdout: vec!["07".to_owned(), "08".to_owned()] }]);
        assert!(plan.method.contains("07, 08") && plan.method.contains("01, 02"), "{}", plan.method);
    }
}
