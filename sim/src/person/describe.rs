//! Description of a person in words.

use crate::clothes::wardrobe::{Beard, Bottom, Hat, Textile};
use crate::config::SimConfig;
use crate::person::look::PersonLook;

/// Describes the configured person in a line of words; two people of the same words may still differ in shape and
/// colours. Renders nothing.
#[must_use]
pub fn describe_person(config: &SimConfig) -> String {
    let look = PersonLook::new(config);
    let age = look.shape.0.get("age").copied().unwrap_or(0.5);
    let who = match (look.female, age) {
        (true, age) if age < 0.36 => "girl",
        (false, age) if age < 0.36 => "boy",
        (true, age) if age > 0.76 => "old woman",
        (false, age) if age > 0.76 => "old man",
        (true, _) => "woman",
        (false, _) => "man",
    };
    let mut words = vec![who.to_owned(), format!("{:?} hair", look.cut)];
    if look.beard != Beard::None {
        words.push(format!("{:?} beard", look.beard));
    }
    match look.hat {
        Hat::None => {}
        Hat::Beanie(cloth) => words.push(format!("{} beanie", cloth_words(&cloth))),
        Hat::Cap(cloth) => words.push(format!("{} cap", cloth_words(&cloth))),
        Hat::Brimmed(cloth) => words.push(format!("{} brimmed hat", cloth_words(&cloth))),
    }
    let top = &look.top;
    let sleeves = if top.sleeve_m > 0.4 { "long-sleeved" } else { "short-sleeved" };
    let dress = matches!(look.bottom, Bottom::Skirt { cloth, .. } if cloth == top.cloth);
    if !dress {
        words.push(format!("{} {sleeves} {:?}", cloth_words(&top.cloth), top.kind));
    }
    words.push(match &look.bottom {
        Bottom::Trousers { cloth, hem_m, .. } if *hem_m > 0.3 => format!("{} shorts", cloth_words(cloth)),
        Bottom::Trousers { cloth, .. } => format!("{} trousers", cloth_words(cloth)),
        Bottom::Overalls { cloth, .. } => format!("{} overalls", cloth_words(cloth)),
        Bottom::Skirt { cloth, .. } if dress => format!("{} {sleeves} dress", cloth_words(cloth)),
        Bottom::Skirt { cloth, .. } => format!("{} skirt", cloth_words(cloth)),
    });
    if let Some(outer) = look.outer {
        let kind = if outer.hem_m < 0.7 { "coat" } else { "jacket" };
        words.push(format!("{} {kind}", cloth_words(&outer.cloth)));
    }
    words.push(format!("{:?} shoes", look.shoes.kind));
    words.join(", ").to_lowercase()
}

fn cloth_words(cloth: &Textile) -> String {
    let print = format!("{:?}", cloth.print);
    let print = print.split('(').next().unwrap_or_default();
    format!("{print} {:?}", cloth.fabric)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;
    use crate::config::Build;

    #[test]
    fn a_thousand_seeds_make_a_thousand_people() {
        let of_seed = |seed| SimConfig { seed, ..SimConfig::default() };
        let shown = |config: &SimConfig| format!("{:?}", PersonLook::new(config));
        let people: HashSet<String> = (0..1000).map(|seed| shown(&of_seed(seed))).collect();
        assert_eq!(people.len(), 1000);
        assert_eq!(shown(&of_seed(5)), shown(&of_seed(5)));
        let mut broad = of_seed(5);
        broad.person.build = Build::BroadMan;
        assert_ne!(shown(&broad), shown(&of_seed(5)));
    }
}
