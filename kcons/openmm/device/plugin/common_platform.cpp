// OpenCL, CUDA and HIP, by OpenMM's Common interface: one library for each, with PLATFORM its name.
#include "steps.h"
#include "openmm/common/ComputeArray.h"
#include "openmm/common/ComputeContext.h"
#include "openmm/common/ComputeForceInfo.h"
#include "openmm/common/ContextSelector.h"
#include "openmm/common/IntegrationUtilities.h"
#include "openmm/opencl/OpenCLPlatform.h"
#include <algorithm>

namespace kcons {

// Two atoms that belong together: OpenMM moves molecules as wholes, and different ones to other places.
class Together : public ComputeForceInfo {
public:
    Together(const vector<int>& tied) : tied(tied) {}
    int getNumParticleGroups() override { return tied.size()/2; }
    void getParticlesInGroup(int k, vector<int>& particles) override { particles = {tied[2*k], tied[2*k+1]}; }
    bool areGroupsIdentical(int, int) override { return true; }
private:
    vector<int> tied;
};

class CommonSteps : public Steps {
public:
    CommonSteps(ComputeContext& cc, const vector<int>& tied)
            : cc(cc), wide(cc.getUseDoublePrecision() || cc.getUseMixedPrecision()) {
        ContextSelector selector(cc);
        if (!tied.empty()) cc.addForce(new Together(tied));
        cc.initializeContexts();
    }
    void execute(ContextImpl& c, const Integrator& integrator, const Shared& shared, int steps) override {
        ContextSelector selector(cc);
        cc.getIntegrationUtilities().setNextStepSize(integrator.getStepSize());
        if (!valid && own.count("cells")) follow();   // who sets positions begins to count cells anew
        Steps::execute(c, integrator, shared, steps);
    }
    vector<double> read(const string& name) override {
        ContextSelector selector(cc);
        if (declared(name).whole) return downloaded<int>(name);
        return wide ? downloaded<double>(name) : downloaded<float>(name);
    }
    void write(const string& name, const vector<double>& values) override {
        ContextSelector selector(cc);
        if (declared(name, values.size()).whole) own.at(name).upload(vector<int>(values.begin(), values.end()));
        else own.at(name).upload(values, true);
    }
    void prepare(ContextImpl& c) override {
        ContextSelector selector(cc);
        for (auto& array : arrays) {
            int size = array.whole ? sizeof(int) : wide ? sizeof(double) : sizeof(float);
            own[array.name].initialize(cc, array.values.size(), size, array.name);
            write(array.name, array.values);
        }
        forces.resize(slots > 1 ? slots : 0);
        for (auto& saved : forces) saved.initialize<long long>(cc, cc.getLongForceBuffer().getSize(), "kconsForces");
        follow();
        cc.addReorderListener(new Follower(*this));
        program = cc.compileProgram(source);
    }
    void launch(const string& name) override {
        ContextSelector selector(cc);
        ComputeKernel& kernel = kernels[name];
        // Arguments in the order of `kernels.py`: numbers, OpenMM's arrays, forces of each group, own arrays.
        if (!kernel) {
            kernel = program->createKernel(name);
            kernel->addArg(cc.getPaddedNumAtoms());
            for (int k = 0; k < 8; k++) kernel->addArg();
            kernel->addArg(cc.getPosq());
            kernel->addArg(cc.getUseMixedPrecision() ? cc.getPosqCorrection() : cc.getPosq());
            kernel->addArg(cc.getVelm());
            kernel->addArg(cc.getAtomIndexArray());
            if (forces.empty()) kernel->addArg(cc.getLongForceBuffer());
            for (auto& saved : forces) kernel->addArg(saved);
            for (auto& array : arrays) if (array.passed) kernel->addArg(own[array.name]);
        }
        kernel->setArg(1, numbers.step);
        kernel->setArg(2, numbers.launch++);
        const double given[] = {numbers.dt, numbers.time, numbers.tolerance};
        for (int k = 0; k < 3; k++) {
            const Vec3& b = numbers.box[k];
            if (wide) kernel->setArg(3+k, given[k]); else kernel->setArg(3+k, (float) given[k]);
            if (wide) kernel->setArg(6+k, mm_double4(b[0], b[1], b[2], 0));
            else kernel->setArg(6+k, mm_float4(b[0], b[1], b[2], 0));
        }
        int groups = min((items+workGroup-1)/workGroup, 256);
        kernel->execute(max(groups, 1)*workGroup, workGroup);
    }
protected:
    void positionsMoved() override { cc.reorderAtoms(); }
    void keepForces(int slot) override { cc.getLongForceBuffer().copyTo(forces[slot]); }
private:
    // Where atoms are, after OpenMM has moved them to other places.
    struct Follower : ComputeContext::ReorderListener {
        CommonSteps& steps;
        Follower(CommonSteps& steps) : steps(steps) {}
        void execute() override { steps.follow(); }
    };
    template <class T> vector<double> downloaded(const string& name) {
        vector<T> values;
        own.at(name).download(values);
        return vector<double>(values.begin(), values.end());
    }
    void follow() {
        const vector<int>& index = cc.getAtomIndex();
        vector<int> place(index.size()), now;
        for (int k = 0; k < cc.getNumAtoms(); k++) place[index[k]] = k;
        // Of particles that rest -1-k, as at first.
        for (int k : declared("atoms").values) now.push_back(k < 0 ? -1-place[-1-k] : place[k]);
        own.at("atoms").upload(now);
        if (own.count("cells")) own.at("cells").uploadSubArray(cc.getPosCellOffsets().data(), 0, 4*cc.getNumAtoms());
    }
    ComputeContext& cc;
    ComputeProgram program;
    map<string, ComputeArray> own;
    map<string, ComputeKernel> kernels;
    vector<ComputeArray> forces;
    const bool wide;     // whether `mixed` is double
};

static const bool registered = (makers()[PLATFORM] = [](ContextImpl& c, const vector<int>& tied) {
    // PlatformData of OpenCL, CUDA and HIP alike begin with the Context and the vector of their contexts, each of which
    // has ComputeContext as its first base.
    auto* data = reinterpret_cast<OpenCLPlatform::PlatformData*>(c.getPlatformData());
    if (data->contexts.size() != 1) throw OpenMMException("kcons: steps on the device run on one device; give one DeviceIndex, or device=False");
    return new CommonSteps(*reinterpret_cast<ComputeContext*>(data->contexts[0]), tied);
}, true);

}
