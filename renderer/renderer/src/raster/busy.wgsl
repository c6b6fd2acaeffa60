// Whether a workgroup's tile still has open pixels.
var<workgroup> busy: atomic<u32>;
var<workgroup> go_on: u32;

// Whether any invocation of the workgroup is busy; to be called by all of them together.
fn any_busy(lane: u32, mine: bool) -> bool {
    if mine {
        atomicStore(&busy, 1u);
    }
    workgroupBarrier();
    if lane == 0u {
        go_on = atomicExchange(&busy, 0u);
    }
    return workgroupUniformLoad(&go_on) != 0u;
}
