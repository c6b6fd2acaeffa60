use super::*;

/// Machine on which each level costs a share of the level before it.
struct Machine {
    budget: Budget,
    random: u32,
    /// Cost of each level as a share of that of the level before it.
    steps: [f64; LEVELS],
}

/// Levels and total time of some frame sets.
struct Course {
    levels: Vec<usize>,
    secs: f64,
}

impl Course {
    fn changes(&self) -> usize {
        self.levels.windows(2).filter(|pair| pair[0] != pair[1]).count()
    }

    fn rate(&self) -> f64 {
        self.levels.len() as f64 / self.secs
    }
}

impl Machine {
    fn new(fps: f64) -> Self {
        let mut steps = [0.8; LEVELS];
        steps[0] = 1.0;
        Self { budget: Budget::new(BudgetSettings { fps, effort: None }), random: 9, steps }
    }

    /// Runs frame sets that would cost `full(i)` seconds with all the work, give or take a quarter.
    fn run(&mut self, sets: u32, full: impl Fn(u32) -> f64) -> Course {
        let mut course = Course { levels: Vec::new(), secs: 0.0 };
        for i in 0..sets {
            self.budget.next_set();
            self.random = self.random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = 0.75 + 0.5 * f64::from(self.random >> 16) / 65_536.0;
            let share: f64 = self.steps[..=self.budget.level()].iter().product();
            let secs = full(i) * share * noise;
            self.budget.spend(flyrig_types::saturating_secs(secs));
            course.levels.push(self.budget.level());
            course.secs += secs;
        }
        course
    }
}

#[test]
fn without_a_budget_everything_gets_all_the_work() {
    for fps in [0.0, f64::NAN, -1.0] {
        let mut machine = Machine::new(fps);
        assert_eq!(machine.run(100, |_| 10.0).levels, [0; 100]);
        assert!(machine.budget.stats().is_none() && machine.budget.fps().is_none());
    }
    let effort = Effort { looks: 1, ..Effort::FULL };
    let fixed = Budget::new(BudgetSettings { fps: 10.0, effort: Some(effort) });
    assert_eq!((fixed.effort(), fixed.fps()), (effort, None));
}

#[test]
fn a_budget_is_kept_with_as_much_work_as_fits_and_without_oscillation() {
    // 0.4 s a set with all the work; each level 0.8 of the one before; usable are 0.85 of the period.
    for (fps, level) in [(1.0, 0), (1.7, 0), (2.26, 1), (2.8, 2), (4.4, 4)] {
        let mut machine = Machine::new(fps);
        machine.run(100, |_| 0.4);
        let course = machine.run(600, |_| 0.4);
        assert!(course.rate() >= fps, "{fps}: {} a second", course.rate());
        let mean = course.levels.iter().sum::<usize>() as f64 / 600.0;
        assert!((mean - level as f64).abs() < 0.6, "{fps}: level {mean}");
        assert!(course.changes() <= 12, "{fps}: {} changes", course.changes());
    }
}

#[test]
fn budgets_that_nothing_and_everything_meets_stay_at_an_end() {
    let mut machine = Machine::new(500.0);
    machine.run(30, |_| 0.4);
    assert!(machine.run(500, |_| 0.4).levels.iter().all(|&level| level == LEVELS - 1));
    assert_eq!(Machine::new(0.5).run(500, |_| 0.4).levels, [0; 500]);
}

#[test]
fn a_busy_neighbour_costs_accuracy_while_it_is_there() {
    let mut machine = Machine::new(2.0);
    assert_eq!(machine.run(100, |_| 0.3).levels, [0; 100]);
    let busy = machine.run(200, |_| 0.6);
    assert!(*busy.levels.last().unwrap() >= 2 && busy.levels[20] >= 1, "{:?}", &busy.levels[..30]);
    assert!(busy.changes() <= 8, "{}", busy.changes());
    let after = machine.run(400, |_| 0.3);
    assert_eq!(*after.levels.last().unwrap(), 0, "{:?}", after.levels);
    // It comes and goes every 40 sets: the level follows it, or stays low, but does not flutter.
    let restless = machine.run(800, |i| if i / 40 % 2 == 0 { 0.3 } else { 0.6 });
    assert!(restless.changes() <= 60, "{}", restless.changes());
}

#[test]
fn one_hiccup_and_sets_that_are_left_out_change_nothing() {
    let mut machine = Machine::new(2.0);
    let course = machine.run(300, |i| if i % 60 == 30 { 4.0 } else { 0.25 });
    assert_eq!(course.changes(), 0);
    let before = machine.budget.stats();
    for _ in 0..50 {
        machine.budget.next_set();
        machine.budget.leave_out();
        machine.budget.spend(Duration::from_secs(9));
    }
    machine.budget.next_set();
    let after = machine.budget.stats();
    assert_eq!(after.map(|stats| stats.level), before.map(|stats| stats.level));
    assert!(after.is_some_and(|stats| stats.set_secs < 0.5));
}

#[test]
fn a_level_that_saves_nothing_is_passed() {
    let mut machine = Machine::new(4.0);
    machine.steps = [1.0, 1.0, 1.0, 0.5, 1.0, 1.0, 0.9];
    let course = machine.run(300, |_| 0.4);
    assert!(course.levels[60..].iter().all(|&level| level >= 3), "{:?}", course.levels);
}
